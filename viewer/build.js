// Writes dist/: the page, its style, the bundled script and the licence of what is bundled. Equal sources give equal bytes.

import { copyFile, mkdir, readFile, writeFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = (path) => fileURLToPath(new URL(path, import.meta.url));
const out = (name) => `${process.argv[2] ?? here("dist")}/${name}`;

await mkdir(out("."), { recursive: true });
const options = {
  bundle: true,
  // A classic script: browsers load no modules from file://.
  format: "iife",
  target: "es2021",
  minify: true,
  charset: "ascii",
  legalComments: "none",
};
await build({
  ...options,
  entryPoints: [here("src/main.js")],
  outfile: out("viewer.js"),
  banner: { js: "/* FlexRoad viewer. Contains three.js (MIT), see LICENSES.txt. */" },
});
// The script of the HTML report, which shares the map; not a file of a viewer, so in a folder of its own.
await build({ ...options, entryPoints: [here("src/report/page.js")], outfile: out("report/page.js") });
for (const name of ["index.html", "viewer.css"]) {
  await copyFile(here(`page/${name}`), out(name));
}
const three = JSON.parse(await readFile(here("node_modules/three/package.json"), "utf8"));
const licence = await readFile(here("node_modules/three/LICENSE"), "utf8");
await writeFile(out("LICENSES.txt"), `viewer.js contains three.js ${three.version}, https://threejs.org\n\n${licence}`);
