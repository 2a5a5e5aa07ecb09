// The overview with its settings: colour, search, and the tiles to look at first.

import { byId, el, fill, show } from "./dom.js";
import { OverviewMap } from "./map.js";
import { choices } from "./map_colours.js";
import { legend, reason, section, select, tileHead, tileId, tileList } from "./panel.js";
import { DONE, FAILED, worst } from "./run.js";
import { count, flagText, isFlagged, stateText } from "./words.js";

const LISTED = 10;

export class MapView {
  /** `open(tile, place)` shows a tile in 3D, at a place on it if one is given; `changed()` is called when the address must be updated. */
  constructor(run, { open, changed }) {
    this.run = run;
    this.open = open;
    this.changed = changed;
    this.choices = choices(run);
    this.choice = this.choices[0];
    this.map = new OverviewMap(byId("map"), run, {
      open: (tile, place) => this.choose(tile, place),
      point: (tile, x, y, flag) => this.tip(tile, x, y, flag),
    });
    this.map.colourBy(this.choice.colour);
  }

  /** Runs the command of a key; returns whether the key has a command. */
  key(event) {
    return this.map.key(event);
  }

  /** Colours the map by a choice; unknown keys are ignored. */
  by(key) {
    const choice = this.choices.find((one) => one.key === key);
    if (!choice) return;
    this.choice = choice;
    this.map.colourBy(choice.colour);
  }

  /** Returns the settings. */
  panel() {
    const [first] = this.choices;
    const rate = this.choices.find((choice) => choice.key === "error_estimate_m");
    const listed = worst(this.run, LISTED);
    this.results = el("div", {});
    this.found = [];
    this.chosen = el("section", { hidden: true });
    return [
      this.chosen,
      section(
        "Colour of the tiles",
        select("Colour of the tiles", this.choices, this.choice.key, (key) => {
          this.by(key);
          fill(this.legend, legend(this.choice.legend, this.choice.ramp));
          this.changed();
        }),
        (this.legend = el("div", {}, legend(this.choice.legend, this.choice.ramp))),
      ),
      section(
        "Find a tile",
        el("input", {
          type: "search",
          placeholder: "Id of a tile",
          "aria-label": "Id of a tile",
          input: (event) => this.find(event.target.value.trim()),
          keydown: (event) => {
            if (event.key === "Enter" && this.found.length) this.choose(this.found[0]);
          },
        }),
        this.results,
      ),
      listed.length
        ? section(
            rate ? "Look at first, by error estimate" : "Look at first",
            tileList(listed, {
              mark: first.colour,
              value: (tile) => (tile.state === DONE ? rate?.text(tile) : null),
              open: (tile, place) => this.choose(tile, place),
            }),
          )
        : null,
    ];
  }

  find(text) {
    const found = (this.found = text ? this.run.tiles.filter((tile) => tile.id.toLowerCase().includes(text.toLowerCase())) : []);
    const more = found.length > LISTED ? el("p", { class: "quiet small" }, `and ${count(found.length - LISTED, "more")}`) : null;
    const none = text && !found.length ? el("p", { class: "quiet small" }, "No tile has this in its id.") : null;
    const list = tileList(found.slice(0, LISTED), {
      mark: this.choices[0].colour,
      value: () => null,
      open: (tile, place) => this.choose(tile, place),
    });
    fill(this.results, list, more, none);
  }

  /** Shows a message that the run has no such tile, and lists tiles with a similar id. */
  lacks(id) {
    this.find(id);
    this.say(el("p", {}, `This run has no tile ${id}.`));
  }

  /** Opens a finished tile; shows a message on other tiles. */
  choose(tile, place = null) {
    this.map.select(tile);
    if (tile.state === DONE) {
      this.open(tile, place);
      return;
    }
    this.say(tileHead(tile), tile.state === FAILED ? null : el("p", { class: "quiet small" }, "It has no surface yet."));
  }

  say(...text) {
    fill(this.chosen, ...text);
    show(this.chosen, true);
    byId("panel").classList.add("open");
    byId("panel-content").scrollTop = 0;
  }

  tip(tile, x, y, flag = null) {
    const element = byId("tip");
    show(element, Boolean(tile));
    if (!tile) return;
    const value = this.choice.text?.(tile);
    fill(
      element,
      el("b", {}, tileId(tile)),
      value ? el("div", {}, `${this.choice.label}: ${value}`) : el("div", {}, stateText(tile)),
      flag || reason(tile) ? el("div", { class: "quiet" }, flag ? `here: ${flagText(flag)}` : reason(tile)) : null,
    );
    const { clientWidth, clientHeight } = byId("map-view");
    element.style.left = `${Math.max(Math.min(x + 16, clientWidth - element.offsetWidth - 8), 8)}px`;
    element.style.top = `${Math.max(Math.min(y + 16, clientHeight - element.offsetHeight - 8), 8)}px`;
  }
}

/** Returns the run's tiles in words: how many are done, failed, flagged. */
export function summary(run) {
  const number = (test) => run.tiles.filter(test).length;
  const parts = [
    [number((tile) => tile.state === DONE), "done"],
    [number((tile) => tile.state === DONE && isFlagged(tile)), "to look at"],
    [number((tile) => tile.state === FAILED), "failed"],
    [number((tile) => tile.state !== DONE && tile.state !== FAILED), "not computed"],
  ];
  const shown = parts.filter(([amount]) => amount).map(([amount, label]) => `${amount} ${label}`);
  return `${count(run.tiles.length, "tile")}: ${shown.join(", ")}`;
}

