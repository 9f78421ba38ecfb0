// Film strips that turn: all frames of a turntable are one picture, of which each layer shows a window.
"use strict";
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;

for (const viewer of document.querySelectorAll(".viewer")) {
  const angle = viewer.querySelector(".angle"), play = viewer.querySelector(".play");
  const stages = [...viewer.querySelectorAll(".stage")], controls = viewer.querySelector(".turn");
  let turning = !still, seen = false, at = 0.125; // half from the side says more than from the front

  function show(turn) {
    at = turn;
    for (const layer of viewer.querySelectorAll(".layer")) {
      const { count, columns, rows } = layer.dataset;
      const frame = Math.floor(turn * count) % count;
      const column = frame % columns, row = Math.floor(frame / columns);
      layer.style.backgroundPosition = `${columns > 1 ? (100 * column) / (columns - 1) : 0}% ${rows > 1 ? (100 * row) / (rows - 1) : 0}%`;
    }
  }
  function label() {
    play.textContent = turning ? "Pause" : "Turn";
  }
  angle.addEventListener("input", () => { turning = false; label(); show(angle.value / 1000); });
  play.addEventListener("click", () => { turning = !turning; label(); });
  for (const input of viewer.querySelectorAll(".wipe")) {
    input.addEventListener("input", () => {
      for (const other of viewer.querySelectorAll(".wipe")) other.value = input.value;
      for (const stage of stages) stage.style.setProperty("--cut", `${input.value / 10}%`);
    });
  }
  for (const button of viewer.querySelectorAll(".tabs button")) {
    button.addEventListener("click", () => {
      for (const other of viewer.querySelectorAll(".tabs button")) other.setAttribute("aria-pressed", other === button);
      for (const stage of stages) stage.hidden = stage.dataset.name !== button.dataset.name;
      hideControls();
    });
  }
  function hideControls() {
    controls.hidden = stages.some((stage) => !stage.hidden && "still" in stage.dataset);
  }
  hideControls();
  new IntersectionObserver(([entry]) => { seen = entry.isIntersecting; }).observe(viewer);
  let before = performance.now();
  function tick(now) {
    if (turning && seen) {
      show((at + (now - before) / 7000) % 1);
      angle.value = at * 1000;
    }
    before = now;
    requestAnimationFrame(tick);
  }
  label();
  show(at);
  angle.value = at * 1000;
  requestAnimationFrame(tick);
}

const model = document.querySelector("model-viewer"), alone = document.querySelector("#alone");
if (model && alone) {
  // The base's materials are cut away rather than removed: the viewer has no other way to hide a part of a file.
  alone.addEventListener("click", () => {
    const hide = alone.getAttribute("aria-pressed") !== "true";
    alone.setAttribute("aria-pressed", hide);
    alone.textContent = hide ? "Show the whole object" : "Show the part alone";
    for (const material of model.model?.materials ?? []) {
      if (!material.name.startsWith("part_")) {
        material.setAlphaMode(hide ? "MASK" : "OPAQUE");
        material.setAlphaCutoff(hide ? 2 : 0.5);
      }
    }
  });
}
