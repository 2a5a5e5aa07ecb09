"""Open a page in Chromium and take steps on it; print what each step gave, as JSON.

Usage: browse.py < JSON with url, program, width, height, dark and steps

A step has one key: ``eval`` (JavaScript), ``wait`` (until JavaScript is true), ``move``, ``click``, ``drag``
or ``tap`` (pixels), ``press`` (selector of what is clicked), ``key``, ``shot`` (x, y, width and height; gives
a PNG in base64). The output has the results, all requests but those of files and data, and all errors of the
page.
"""

import base64
import json
import sys

from playwright.sync_api import Page, sync_playwright

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE_MS = 120_000
SETTLED_MS = 400


def take(page: Page, step: dict) -> object:
    """Take one step; return what it gives."""
    ((kind, value),) = step.items()
    if kind == "eval":
        return page.evaluate(value)
    if kind == "shot":
        page.wait_for_timeout(SETTLED_MS)
        x, y, width, height = value
        clip = {"x": x, "y": y, "width": width, "height": height}
        return base64.b64encode(page.screenshot(clip=clip)).decode()
    if kind == "wait":
        page.wait_for_function(value, timeout=PATIENCE_MS)
    elif kind == "move":
        page.mouse.move(*value)
        page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    elif kind == "click":
        page.mouse.click(*value)
    elif kind == "drag":
        page.mouse.move(*value[:2])
        page.mouse.down()
        page.mouse.move(*value[2:], steps=5)
        page.mouse.up()
    elif kind == "tap":
        page.touchscreen.tap(*value)
    elif kind == "press":
        page.locator(value).first.click(timeout=PATIENCE_MS)
    elif kind == "key":
        page.keyboard.press(value)
    else:
        raise ValueError(f"unknown step {kind}")
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
        page.on("request", lambda request: requests.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
        page.goto(wanted["url"], timeout=PATIENCE_MS)
        results = [take(page, step) for step in wanted["steps"]]
        browser.close()
    others = [url for url in requests if not url.startswith(("file:", "data:"))]
    json.dump({"results": results, "requests": others, "errors": errors}, sys.stdout)


main()
