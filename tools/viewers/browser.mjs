// Headless Chromium, drawing in software, and a server of this machine's own for pages that it shows.
import { createServer } from "node:http";
import { mkdtemp, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium } from "playwright-core";

const QUIET = ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic", "--no-first-run"];
const SOFTWARE_GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];

// Calls `drive(browser)` with a browser of its own, which is gone afterwards. Options are those of playwright's context.
export async function withBrowser(options, drive) {
  const profile = await mkdtemp(join(tmpdir(), "page-"));
  const browser = await chromium.launchPersistentContext(profile, {
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    headless: true,
    timeout: 180000,
    args: [...SOFTWARE_GL, ...QUIET],
    ...options,
  });
  try {
    return await drive(browser);
  } finally {
    await browser.close();
    await rm(profile, { recursive: true, force: true });
  }
}

// Calls `use(url)` while `answer(path)`, a promise of [kind, data] or nothing, is what the server at that address says.
export async function withServer(answer, use) {
  const server = createServer(async (request, response) => {
    const found = await answer(decodeURIComponent(new URL(request.url, "http://page").pathname)).catch(() => null);
    if (found) response.writeHead(200, { "content-type": found[0] }).end(found[1]);
    else response.writeHead(404).end();
  });
  await new Promise((done) => server.listen(0, "127.0.0.1", done));
  try {
    return await use(`http://127.0.0.1:${server.address().port}/`);
  } finally {
    server.close();
  }
}
