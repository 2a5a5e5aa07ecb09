"""Show a 3D Tiles tileset in CesiumJS in headless Chromium, from a server of this process and no network.

Usage: cesium_page.py CESIUM BROWSER FOLDER TASK

CESIUM is the npm package, FOLDER has ``tileset.json``, and TASK is a JSON file with one of

- ``points``: longitudes and latitudes (degrees) whose heights are picked, with all details loaded,
- ``camera``: ``centre`` (longitude, latitude, height), ``heading`` and ``pitch`` (degrees), ``range`` (m) and
  ``error_px``, the largest geometric error (pixels); and ``picture``, the PNG to be written.

Prints the heights, or the names of the GLB files in the picture, and what went wrong, as JSON.
"""

import functools
import json
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from playwright.sync_api import Page, Route, sync_playwright

# Chromium in a container has neither a sandbox nor a GPU.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SECONDS = 400
PAGE = """<!doctype html><meta charset="utf-8"><style>html,body,#map{margin:0;width:100%;height:100%}</style>
<link rel="stylesheet" href="/cesium/Build/Cesium/Widgets/widgets.css">
<div id="map"></div><script>window.CESIUM_BASE_URL = "/cesium/Build/Cesium/"</script>
<script src="/cesium/Build/Cesium/Cesium.js"></script>"""
LOAD = """async () => {
  const widget = new Cesium.CesiumWidget("map", {
    baseLayer: false, globe: false, skyBox: false, skyAtmosphere: false,
  });
  window.scene = widget.scene;
  window.tileset = await Cesium.Cesium3DTileset.fromUrl("/tiles/tileset.json");
  window.failures = [];
  tileset.tileFailed.addEventListener(event => failures.push(event.url + ": " + event.message));
  scene.primitives.add(tileset);
  return Cesium.VERSION;
}"""
HEIGHTS = """async points => {
  const places = points.map(([east, north]) => Cesium.Cartographic.fromDegrees(east, north));
  const found = await scene.sampleHeightMostDetailed(places);
  return found.map(place => place.height === undefined ? null : place.height);
}"""
SHOW = """async ({centre, heading, pitch, range, error_px}) => {
  scene.backgroundColor = Cesium.Color.fromCssColorString("#dfe7ee");
  scene.msaaSamples = 8;
  scene.highDynamicRange = false;
  tileset.maximumScreenSpaceError = error_px;
  const [east, north, height] = centre;
  const target = Cesium.Cartesian3.fromDegrees(east, north, height);
  const view = new Cesium.HeadingPitchRange(
    Cesium.Math.toRadians(heading), Cesium.Math.toRadians(pitch), range);
  scene.camera.lookAt(target, view);
  const frame = Cesium.Transforms.eastNorthUpToFixedFrame(target);
  const down = Cesium.Matrix4.multiplyByPointAsVector(
    frame, new Cesium.Cartesian3(0.55, 0.35, -0.75), new Cesium.Cartesian3());
  scene.light = new Cesium.DirectionalLight(
    {direction: Cesium.Cartesian3.normalize(down, down), intensity: 2.6});
  for (let still = 0; still < 10; still = tileset.tilesLoaded ? still + 1 : 0) {
    await new Promise(done => setTimeout(done, 200));
  }
  return tileset._selectedTiles.map(tile => tile.content.url.split("/tiles/").slice(1).join("/tiles/"));
}"""


class Files(SimpleHTTPRequestHandler):
    """Serves the page, the package and the tileset."""

    def __init__(self, *arguments: object, roots: dict[str, str]) -> None:
        self.roots = roots
        super().__init__(*arguments)  # type: ignore[arg-type]

    def translate_path(self, path: str) -> str:
        """Return the file of a request."""
        _, root, *parts = path.partition("?")[0].split("/")
        return str(Path(self.roots.get(root, "/nonexistent"), *parts))

    def do_GET(self) -> None:
        """Answer with the page or a file."""
        if self.path != "/":
            super().do_GET()
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(PAGE.encode())

    def log_message(self, *_: object) -> None:
        """Print nothing."""


def main(cesium: str, browser: str, folder: str, task_file: str) -> None:
    """Serve, show, and print what was found."""
    task = json.loads(Path(task_file).read_text())
    handler = functools.partial(Files, roots={"cesium": cesium, "tiles": folder})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, sync_playwright() as playwright:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        here = f"http://127.0.0.1:{server.server_port}/"
        with playwright.chromium.launch(executable_path=browser, args=FLAGS) as chromium:
            page = chromium.new_page(viewport={"width": 1200, "height": 675})
            page.set_default_timeout(SECONDS * 1000)
            json.dump(shown(page, here, task), sys.stdout)
        server.shutdown()


def shown(page: Page, here: str, task: dict[str, object]) -> dict[str, object]:
    """Return the picked heights and what went wrong."""
    outside: list[str] = []
    errors: list[str] = []

    def local_only(route: Route) -> None:
        url = route.request.url
        if url.startswith((here, "data:", "blob:")):
            route.continue_()
        else:
            outside.append(url)
            route.abort()

    page.route("**/*", local_only)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(here)
    result: dict[str, object] = {"version": page.evaluate(LOAD)}
    if "points" in task:
        result["heights"] = page.evaluate(HEIGHTS, task["points"])
    else:
        result["shown"] = page.evaluate(SHOW, task["camera"])
        page.screenshot(path=str(task["picture"]))
    return result | {"failures": page.evaluate("failures"), "outside": outside, "errors": errors}


main(*sys.argv[1:])
