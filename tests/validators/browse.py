"""Open a page in Chromium and take steps on it; print what each step gave, as JSON.

Usage: browse.py < JSON with url, program, width, height, dark and steps

A step has one key: ``eval`` (JavaScript), ``wait`` (until JavaScript is true), ``move``, ``click``, ``drag``
or ``tap`` (pixels), ``pinch`` (middle, and distance of two fingers from it before and after; pixels),
``press`` (selector of what is clicked, or selector, x and y in it), ``focus`` (selector), ``select``
(selector and value), ``key``, ``shot`` (x, y, width and height; gives a PNG in base64). The output has the
results, all requests except for files and data, all errors of the page, and whether the page is wider than
the window.
"""

import base64
import json
import sys

from playwright.sync_api import Page, sync_playwright

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE_MS = 120_000
SETTLED_MS = 400
DRAWN = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
WIDE = "document.documentElement.scrollWidth > window.innerWidth"


def shot(page: Page, box: list[int]) -> str:
    """Return a part of the page as PNG in base64."""
    page.wait_for_timeout(SETTLED_MS)
    clip = dict(zip(("x", "y", "width", "height"), box, strict=True))
    return base64.b64encode(page.screenshot(clip=clip)).decode()


def drag(page: Page, way: list[int]) -> None:
    """Drag the mouse from a place to another."""
    page.mouse.move(*way[:2])
    page.mouse.down()
    page.mouse.move(*way[2:], steps=5)
    page.mouse.up()


def pinch(page: Page, way: list[int]) -> None:
    """Move two fingers, beside each other, away from a place or towards it."""
    x, y, before, after = way
    browser = page.context.new_cdp_session(page)

    def touch(kind: str, *apart: float) -> None:
        fingers = [{"x": x + side * away, "y": y, "id": side + 1} for away in apart for side in (-1, 1)]
        browser.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

    touch("touchStart", before)
    for step in range(1, 6):
        touch("touchMove", before + (after - before) * step / 5)
    touch("touchEnd")


def press(page: Page, value: str | list) -> None:
    """Click on an element, in its middle or at a place in it."""
    selector, *place = [value] if isinstance(value, str) else value
    position = {"x": place[0], "y": place[1]} if place else None
    page.locator(selector).first.click(position=position)


def select(page: Page, value: list[str]) -> None:
    """Choose a value of a list, and wait until the page has changed."""
    selector, chosen = value
    page.locator(selector).select_option(chosen)
    page.wait_for_timeout(SETTLED_MS)


ASKED = {
    "eval": lambda page, code: page.evaluate(code),
    "shot": shot,
}
DONE = {
    "wait": lambda page, code: page.wait_for_function(code),
    "move": lambda page, place: page.mouse.move(*place),
    "click": lambda page, place: page.mouse.click(*place),
    "drag": drag,
    "tap": lambda page, place: page.touchscreen.tap(*place),
    "pinch": pinch,
    "press": press,
    "focus": lambda page, selector: page.locator(selector).focus(),
    "select": select,
    "key": lambda page, name: page.keyboard.press(name),
}


def take(page: Page, step: dict) -> object:
    """Take one step; return what it gives."""
    ((kind, value),) = step.items()
    if kind in ASKED:
        return ASKED[kind](page, value)
    DONE[kind](page, value)
    page.evaluate(DRAWN)
    return None


def main() -> None:
    """Take the steps."""
    wanted = json.load(sys.stdin)
    requests, errors = [], []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=wanted["program"], args=FLAGS)
        page = browser.new_page(
            viewport={"width": wanted["width"], "height": wanted["height"]},
            color_scheme="dark" if wanted.get("dark") else "light",
            has_touch=wanted["width"] < 600,
        )
        page.set_default_timeout(PATIENCE_MS)
        page.on("request", lambda request: requests.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
        page.goto(wanted["url"])
        page.evaluate(DRAWN)
        results = [take(page, step) for step in wanted["steps"]]
        wide = page.evaluate(WIDE)
        browser.close()
    others = [url for url in requests if not url.startswith(("file:", "data:"))]
    json.dump({"results": results, "requests": others, "errors": errors, "wide": wide}, sys.stdout)


main()
