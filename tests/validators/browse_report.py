"""Open a page in a browser and take steps on it: ``python browse_report.py FILE < steps.json``.

Prints the results of the steps, the requests, the errors of the page and whether it is wider than the window,
as JSON. Run by the interpreter of `tests.validators`, which has Playwright.
"""

import json
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright


def take(page, step):
    """Take one step and return its result."""
    match step:
        case {"js": code}:
            return page.evaluate(code)
        case {"click": selector, "at": [x, y]}:
            page.locator(selector).click(position={"x": x, "y": y})
        case {"click": selector}:
            page.locator(selector).click()
        case {"focus": selector}:
            page.locator(selector).focus()
        case {"press": key}:
            page.keyboard.press(key)
        case {"select": selector, "value": value}:
            page.locator(selector).select_option(value)
        case {"picture": path}:
            page.screenshot(path=path)
    page.wait_for_timeout(400)
    return None


def main(file: Path, setting: dict) -> dict:
    """Return what the page does."""
    requests, errors = [], []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=setting["browser"], args=["--no-sandbox"])
        page = browser.new_page(
            viewport={"width": setting["width"], "height": 900}, color_scheme=setting["scheme"]
        )
        page.set_default_timeout(120_000)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: message.type == "error" and errors.append(message.text))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(file.as_uri() + setting["hash"])
        page.wait_for_timeout(500)
        results = [take(page, step) for step in setting["steps"]]
        wide = page.evaluate("document.documentElement.scrollWidth > window.innerWidth")
        browser.close()
    outside = [url for url in requests if not url.startswith(("data:", file.as_uri()))]
    return {"results": results, "requests": outside, "errors": errors, "wide": wide}


if __name__ == "__main__":
    json.dump(main(Path(sys.argv[1]), json.load(sys.stdin)), sys.stdout)
