// node screenshot_glb.mjs FILE.glb PICTURE.png [ORBIT]: the file as <model-viewer> shows it in headless Chromium.
// Prints the viewer's own account of the file as JSON: materials, and its dimensions in metres.
import { readFile, writeFile } from "node:fs/promises";
import { join } from "node:path";
import { withBrowser, withServer } from "./browser.mjs";

const [model, picture, orbit = "30deg 75deg auto"] = process.argv.slice(2);
const here = new URL(".", import.meta.url).pathname;
const page_text = `<!doctype html><meta charset="utf-8">
<style>html, body { margin: 0 } model-viewer { width: 480px; height: 480px; background: #fff; --poster-color: transparent }</style>
<script type="module" src="/viewer.js"></script>
<model-viewer src="/model.glb" camera-orbit="${orbit}" tone-mapping="neutral" interaction-prompt="none"></model-viewer>`;
const answers = {
  "/": ["text/html", async () => page_text],
  "/viewer.js": ["text/javascript", () => readFile(join(here, "node_modules/@google/model-viewer/dist/model-viewer.min.js"))],
  "/favicon.ico": ["image/x-icon", async () => ""],
  "/model.glb": ["model/gltf-binary", () => readFile(model)],
};
const answer = async (path) => answers[path] && [answers[path][0], await answers[path][1]()];
const viewport = { width: 480, height: 480 };
await withServer(answer, (url) => withBrowser({ viewport }, async (browser) => {
  const page = await browser.newPage();
  const problems = [];
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && problems.push(message.text()));
  await page.goto(url);
  await page.waitForFunction(() => document.querySelector("model-viewer")?.loaded, null, { timeout: 150000 });
  await page.waitForTimeout(3000);
  const found = await page.evaluate(() => {
    const viewer = document.querySelector("model-viewer");
    const { x, y, z } = viewer.getDimensions();
    // Not the browser's own screenshot, which waits for a moment without drawing: on a busy machine there is none.
    const picture = viewer.toDataURL("image/png");
    return { dimensions: [x, y, z], materials: viewer.model.materials.map((material) => material.name), picture };
  });
  await writeFile(picture, Buffer.from(found.picture.split(",")[1], "base64"));
  console.log(JSON.stringify({ dimensions: found.dimensions, materials: found.materials, problems }));
}));
