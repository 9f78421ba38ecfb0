// node screenshot_glb.mjs FILE.glb PICTURE.png [ORBIT]: the file as <model-viewer> shows it in headless Chromium.
// Prints the viewer's own account of the file as JSON: materials, and its dimensions in metres.
import { createServer } from "node:http";
import { mkdtemp, readFile, rm, writeFile } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium } from "playwright-core";

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
const server = createServer(async (request, response) => {
  const answer = answers[request.url];
  if (!answer) return response.writeHead(404).end();
  response.writeHead(200, { "content-type": answer[0] }).end(await answer[1]());
});
await new Promise((done) => server.listen(0, "127.0.0.1", done));
const profile = await mkdtemp(join(tmpdir(), "viewer-"));
const quiet = ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic", "--no-first-run"];
const browser = await chromium.launchPersistentContext(profile, {
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  headless: true,
  viewport: { width: 480, height: 480 },
  args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", ...quiet],
});
try {
  const page = await browser.newPage();
  const problems = [];
  page.on("console", (message) => ["error", "warning"].includes(message.type()) && problems.push(message.text()));
  await page.goto(`http://127.0.0.1:${server.address().port}/`);
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
} finally {
  await browser.close();
  server.close();
  await rm(profile, { recursive: true, force: true });
}
