// Tables that sort by a click on a heading, and the table of all tiles, which is made when it is opened.

import { STATE_KEYS, element, flagNamesOf, format } from "./colours.js";
import { DATA } from "./data.js";

const PAGE_ROWS = 100;

function sortKey(text) {
  const number = Number(text.replace(/,/g, "").replace(/[%°]$/, ""));
  return text.trim() !== "" && Number.isFinite(number) ? number : text;
}

// Numbers before texts, empty cells last in both directions.
function compareKeys(a, b, direction) {
  const empty = (v) => v === "–" || v === "" || v === null || v === undefined;
  if (empty(a) || empty(b)) return empty(a) - empty(b);
  if (typeof a !== typeof b) return (typeof a === "number" ? -1 : 1) * direction;
  return (typeof a === "number" ? a - b : String(a).localeCompare(String(b), "en")) * direction;
}

// Give the headings of a table buttons; sort(column, direction) is called by them.
function sortableHeadings(headings, sort) {
  headings.forEach((heading, column) => {
    const button = element("button", { type: "button" });
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", () => {
      // Numbers: the largest first.
      const first = heading.classList.contains("number") ? "descending" : "ascending";
      const last = heading.getAttribute("aria-sort");
      const next = !last ? first : last === "ascending" ? "descending" : "ascending";
      headings.forEach((one) => one.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", next);
      sort(column, next === "ascending" ? 1 : -1);
    });
  });
}

export function makeSortable(table) {
  const body = table.tBodies[0];
  sortableHeadings([...table.tHead.rows[0].cells], (column, direction) => {
    const rows = [...body.rows].map((row) => [sortKey(row.cells[column].textContent), row]);
    rows.sort((a, b) => compareKeys(a[0], b[0], direction));
    body.append(...rows.map(([, row]) => row));
  });
}

export class TileList {
  constructor(box, select) {
    this.box = box;
    this.select = select;
    this.order = DATA.ids.map((_, i) => i);
    this.rows = PAGE_ROWS;
    this.columns = [
      { label: "tile", value: (i) => DATA.ids[i] },
      { label: "state", value: (i) => DATA.stateNames[STATE_KEYS[DATA.states[i]]] },
      { label: "flags or error", value: (i) => DATA.errors[i] || flagNamesOf(i).join(", ") },
      ...DATA.columns.filter((c) => c.values).slice(0, 8).map((c) => ({
        label: c.unit ? `${c.label} (${c.unit})` : c.label, number: true, value: (i) => c.values[i] })),
    ];
    this.build();
  }

  build() {
    const search = element("input", { type: "search", "aria-label": "Find tiles", placeholder: "id, state or flag" });
    search.addEventListener("input", () => { this.words = search.value.toLowerCase(); this.rows = PAGE_ROWS; this.fill(); });
    const head = element("tr", {}, ...this.columns.map((c) => element("th", { class: c.number ? "number" : "text" }, c.label)));
    this.body = element("tbody");
    this.more = element("button", { type: "button", class: "plain" });
    this.more.addEventListener("click", () => { this.rows += 5 * PAGE_ROWS; this.fill(); });
    this.words = "";
    this.box.replaceChildren(element("p", {}, element("label", {}, "Find ", search)),
      element("div", { class: "wide" }, element("table", {}, element("thead", {}, head), this.body)), this.more);
    sortableHeadings([...head.cells], (column, direction) => {
      const value = this.columns[column].value;
      this.order.sort((a, b) => compareKeys(value(a), value(b), direction) || a - b);
      this.fill();
    });
    this.fill();
  }

  fill() {
    const matches = this.order.filter((i) => !this.words ||
      this.columns.slice(0, 3).some((c) => c.value(i).toLowerCase().includes(this.words)));
    this.body.replaceChildren(...matches.slice(0, this.rows).map((i) => this.row(i)));
    const left = matches.length - this.rows;
    this.more.hidden = left <= 0;
    this.more.textContent = `Show more (${left.toLocaleString("en-US")} left)`;
  }

  row(i) {
    const cells = this.columns.map((c, k) => {
      const value = c.value(i);
      if (c.number) return element("td", { class: "number" }, format(value));
      if (k) return element("td", {}, value || "–");
      const button = element("button", { type: "button", class: "link" }, value);
      button.addEventListener("click", () => this.select(i));
      return element("td", {}, button);
    });
    return element("tr", {}, ...cells);
  }
}
