// node unlit_three.mjs FOLDER OUT JSON: mesh files of a folder as three.js shows them in headless Chromium, unlit.
// JSON: a list of {"name": "box.glb", "eye": [x, y, z], "target": [x, y, z], "fov": degrees, "size": pixels}, and for a
// PLY "map", the image that it names. OUT gets a PNG for each, transparent where nothing is. Prints problems as JSON.
import { readFile, writeFile } from "node:fs/promises";
import { extname, join, normalize } from "node:path";
import { withBrowser, withServer } from "./browser.mjs";

const [folder, out, given] = process.argv.slice(2);
const three = new URL("node_modules/three/", import.meta.url).pathname;
const kinds = { ".js": "text/javascript", ".html": "text/html", ".png": "image/png", ".jpg": "image/jpeg" };
const page_text = `<!doctype html><meta charset="utf-8">
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { MTLLoader } from "three/addons/loaders/MTLLoader.js";
import { OBJLoader } from "three/addons/loaders/OBJLoader.js";
import { PLYLoader } from "three/addons/loaders/PLYLoader.js";

// OBJ: a map replaces the colour beside it, which exporters write but mean nothing by; a colour alone is linear, as
// Blender writes it, where three.js takes it for sRGB.
function asExported(material) {
  if (material.map) material.color.set(1, 1, 1);
  else material.color.convertLinearToSRGB();
}

// The extension turns UVs that were scaled; this version of three.js scales UVs that were turned.
function inOrder(map) {
  if (!map?.rotation) return;
  const c = Math.cos(map.rotation), s = Math.sin(map.rotation), { x, y } = map.repeat;
  map.matrixAutoUpdate = false;
  map.matrix.set(c * x, s * y, map.offset.x, -s * x, c * y, map.offset.y, 0, 0, 1);
}

async function loaded({ name, map }) {
  const url = "/files/" + encodeURIComponent(name);
  if (/\\.gl(b|tf)$/.test(name)) return (await new GLTFLoader().loadAsync(url)).scene;
  if (name.endsWith(".obj")) {
    const library = /^mtllib (.*)$/m.exec(await (await fetch(url)).text());
    const materials = library && (await new MTLLoader().setPath("/files/").loadAsync(library[1].trim()));
    const model = await new OBJLoader().setMaterials(materials).loadAsync(url);
    if (materials) Object.values(materials.materials).forEach(asExported);
    return model;
  }
  const geometry = await new PLYLoader().loadAsync(url);
  const texture = map ? await new THREE.TextureLoader().loadAsync("/files/" + map) : null;
  if (texture) Object.assign(texture, { colorSpace: THREE.SRGBColorSpace, wrapS: THREE.RepeatWrapping, wrapT: THREE.RepeatWrapping });
  return new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ map: texture, vertexColors: !!geometry.attributes.color }));
}

// All of it is shown, also where its alpha says otherwise.
function unlit({ map, color, vertexColors }) {
  inOrder(map);
  return new THREE.MeshBasicMaterial({ map, color, vertexColors, side: THREE.DoubleSide });
}

const renderer = new THREE.WebGLRenderer({ alpha: true, preserveDrawingBuffer: true });
window.shot = async (job) => {
  const model = await loaded(job);
  await new Promise((done) => setTimeout(done, 1500)); // images of an MTL, which nobody waits for
  model.traverse((node) => {
    if (node.isMesh) node.material = Array.isArray(node.material) ? node.material.map(unlit) : unlit(node.material);
  });
  const scene = new THREE.Scene().add(model), camera = new THREE.PerspectiveCamera(job.fov, 1, 0.01, 1000);
  camera.position.set(...job.eye);
  camera.lookAt(...job.target);
  renderer.setSize(job.size, job.size);
  renderer.render(scene, camera);
  return renderer.domElement.toDataURL("image/png");
};
window.ready = true;
</script>`;

async function answer(path) {
  const asked = normalize(path);
  const data = asked === "/" ? page_text
    : asked.startsWith("/three/") ? await readFile(join(three, asked.slice(7)))
    : asked.startsWith("/files/") ? await readFile(join(folder, asked.split(/[\\/]/).at(-1)))
    : "";
  return [kinds[extname(asked) || ".html"] ?? "application/octet-stream", data];
}

await withServer(answer, (url) => withBrowser({}, async (browser) => {
  const page = await browser.newPage(), problems = [];
  page.on("pageerror", (error) => problems.push(String(error)));
  await page.goto(url);
  await page.waitForFunction(() => window.ready, null, { timeout: 150000 });
  for (const job of JSON.parse(given)) {
    const picture = await page.evaluate((job) => window.shot(job), job);
    await writeFile(join(out, `${job.name}.png`), Buffer.from(picture.split(",")[1], "base64"));
  }
  console.log(JSON.stringify(problems));
}));
