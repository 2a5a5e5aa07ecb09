// Check GLB files by the Khronos validator; print the issues of each file but hints, as JSON.
// Usage: node validate_gltf.js PACKAGE FILE...
const fs = require("fs");
const [folder, ...files] = process.argv.slice(2);
const validator = require(folder);

async function main() {
  const issues = {};
  for (const file of files) {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)));
    issues[file] = report.issues.messages.filter(({ severity }) => severity < 2);
  }
  process.stdout.write(JSON.stringify(issues));
}

main();
