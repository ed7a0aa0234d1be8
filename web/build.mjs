// Bundle src/main.js with three.js into quadjax/view/assets, with the license of three.js.
import { createHash } from "node:crypto";
import { copyFileSync, readFileSync, readdirSync, statSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const assets = new URL("../quadjax/view/assets/", import.meta.url).pathname;
const source = new URL("src/", import.meta.url).pathname;
const hash = createHash("sha256");
for (const name of readdirSync(source).sort()) hash.update(readFileSync(source + name));
await build({
  banner: { js: `// quadjax viewer, built by web/build.mjs from sources ${hash.digest("hex")}` },
  absWorkingDir: new URL(".", import.meta.url).pathname,
  entryPoints: ["src/main.js"],
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "inline",
  outfile: `${assets}viewer.js`,
});
// The bundle stands inside an HTML script element, which the text </script would end.
const text = readFileSync(`${assets}viewer.js`, "utf8").replaceAll("</script", "<\\/script");
writeFileSync(`${assets}viewer.js`, text);
copyFileSync(new URL("node_modules/three/LICENSE", import.meta.url).pathname,
  `${assets}three.LICENSE`);
console.log(`viewer.js: ${(statSync(`${assets}viewer.js`).size / 1024).toFixed(0)} KiB`);
