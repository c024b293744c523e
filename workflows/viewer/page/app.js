// The page: opens the map, wires panel, pointer and keys to the picture, draws when something has changed.

import { Vector3 } from "./vendor.js";
import { Cloud, MODES, modesOf, pointMaterial } from "./cloud.js";
import { lineLayers } from "./layers.js";
import { Overlay } from "./measure.js";
import { $, classColours, colourButtons, describeMap, layerSwitch, number, objectColours, pointRows, showCard, showMode } from "./panel.js";
import { pick } from "./picking.js";
import { View } from "./scene.js";

const DATA = "/data/";
const PATIENCE = 5; // while points arrive a fifth of the time is spent on drawing them
const LONGEST_MS = 5000;
const narrow = () => matchMedia("(max-width: 640px)").matches;

class App {
  constructor(map, view) {
    this.map = map;
    this.view = view;
    this.dirty = true;
    this.measuring = false;
    this.budget = 10 ** 6.5;
    this.size = 1.5;
    this.stale = false;
    this.drawn = 0;
    const changed = () => { this.stale = true; };
    this.material = pointMaterial(map);
    this.cloud = new Cloud(`${DATA}tileset/`, this.material, changed);
    this.removed = null;
    this.overlay = new Overlay($("overlay"), view);
    view.scene.add(this.cloud.group);
    this.low = new Vector3(...map.most_m[0]);
    this.high = new Vector3(...map.most_m[1]);
    this.opened = performance.now();
  }

  // --- what can be chosen ---

  colour(mode) {
    this.mode = mode;
    this.material.uniforms.mode.value = MODES.indexOf(mode);
    showMode(mode, this.map);
    this.dirty = true;
  }

  setSize(size) {
    this.size = Math.min(Math.max(size, 0.5), 4);
    $("size").value = this.size;
    $("size-out").textContent = `${this.size.toFixed(1)} px`;
    this.dirty = true;
  }

  setBudget(exponent) {
    this.budget = 10 ** exponent;
    $("budget-out").textContent = this.budget >= 1e6 ? `${(this.budget / 1e6).toFixed(1)} M` : `${Math.round(this.budget / 1e3)} k`;
    this.dirty = true;
  }

  use(top) {
    this.view.use(top);
    $("top").classList.toggle("on", top);
    $("perspective").classList.toggle("on", !top);
    this.dirty = true;
  }

  fit() {
    const panel = $("panel").getBoundingClientRect();
    const margin = narrow() ? { left: 8, right: 8, top: 60, bottom: innerHeight - panel.top } : { left: panel.right, right: 12, top: 24, bottom: 40 };
    this.view.fit(this.low, this.high, margin);
    this.dirty = true;
  }

  measure(on) {
    this.measuring = on;
    $("measure").setAttribute("aria-pressed", String(on));
    $("canvas").style.cursor = on ? "crosshair" : "";
    if (on) {
      this.clear();
      showCard("Measure", [["", "Click two or more points; double-click or Esc ends."]]);
    }
    this.dirty = true;
  }

  clear() {
    this.overlay.picked = null;
    this.overlay.line = [];
    $("card").hidden = true;
    this.dirty = true;
  }

  async showRemoved(on) {
    if (!this.removed) {
      const material = this.material.clone();
      material.uniforms.mode.value = MODES.indexOf("class");
      this.removed = new Cloud(`${DATA}removed/`, material, () => { this.stale = true; });
      this.view.scene.add(this.removed.group);
    }
    this.removed.group.visible = on;
    this.dirty = true;
  }

  // --- points ---

  click(x, y) {
    const found = pick(this.view, [this.cloud, this.removed].filter(Boolean), x, y);
    if (!found) return null;
    if (this.measuring) this.addCorner(found.point);
    else this.describe(found);
    this.dirty = true;
    return found;
  }

  addCorner(point) {
    this.overlay.line.push(point);
    const { space, plane, rise } = this.overlay.lengths;
    const metres = (value) => `${value.toFixed(3)} m`;
    showCard("Measure", [["Length", metres(space)], ["On the plane", metres(plane)], ["Height difference", metres(rise)], ["Points", String(this.overlay.line.length)]]);
  }

  async describe(found) {
    this.overlay.picked = found.point;
    const kind = found.cloud === this.removed ? "removed/point" : "point";
    const answer = await fetch(`${DATA}${kind}/${found.part.userData.node}/${found.row}`);
    if (!answer.ok || this.overlay.picked !== found.point) return;
    const about = await answer.json();
    this.about = about;
    const text = about.epsg
      ? `${about.easting_m.toFixed(3)} ${about.northing_m.toFixed(3)} ${about.height_m.toFixed(3)} EPSG:${about.epsg}`
      : about.map_m.map((v) => v.toFixed(3)).join(" ");
    const what = about.why ? "Removed point" : "Point";
    showCard(about.epsg ? `${what} in EPSG:${about.epsg}` : what, pointRows(about), text);
  }

  // --- drawing ---

  // What the user does is seen at once. What arrives is seen a few times a second, and where drawing is slow less often, so
  // that it leaves most of the time to reading.
  due(now) {
    const cost = this.view.drawingTook(); // null while the last picture is being drawn
    const rest = this.cloud.busy || this.removed?.busy ? Math.min(Math.max(120, PATIENCE * cost), cost + LONGEST_MS) : 0;
    const waited = cost !== null && now - this.drawn > rest;
    if (!this.dirty && !(this.stale && waited)) return false;
    this.dirty = this.stale = false;
    this.drawn = now;
    return true;
  }

  frame() {
    const { view, cloud } = this;
    cloud.update(view.camera, view.renderer, this.budget);
    if (this.removed) this.removed.update(view.camera, view.renderer, this.budget / 4);
    if (!this.due(performance.now())) return;
    const ratio = view.renderer.getPixelRatio();
    for (const { material } of [cloud, this.removed].filter(Boolean)) {
      const { uniforms } = material;
      uniforms.pixels.value = this.size * ratio;
      uniforms.metres.value = this.map.voxel_size_m * 0.75 * this.size;
      uniforms.perMetre.value = view.perMetre;
    }
    view.draw();
    this.overlay.draw();
    this.status();
    if (cloud.busy || this.removed?.busy) this.stale = true;
  }

  status() {
    const shown = this.cloud.shown;
    const removed = this.removed?.shown ? ` · ${number(this.removed.shown)} removed` : "";
    const failed = this.cloud.failed ? ` · ${this.cloud.failed} parts could not be read` : "";
    $("count").textContent = `${number(shown)} of ${number(this.map.points)}${narrow() ? "" : " points"}${removed}${this.cloud.busy ? " …" : ""}${failed}`;
    const { isTop, perMetre, renderer } = this.view;
    $("scale").hidden = !isTop;
    if (!isTop) return;
    const pixels = perMetre / renderer.getPixelRatio();
    const wide = 10 ** Math.floor(Math.log10(110 / pixels));
    const length = [5, 2, 1].map((f) => f * wide).find((l) => l * pixels <= 110) ?? wide;
    $("scale").querySelector("i").style.width = `${length * pixels}px`;
    $("scale").querySelector("b").textContent = length >= 1000 ? `${length / 1000} km` : `${length} m`;
  }
}

// --- starting ---

function say(text) {
  $("message").textContent = text;
  $("message").hidden = false;
}

function wire(app) {
  const canvas = $("canvas");
  colourButtons(app.map, (mode) => app.colour(mode));
  $("top").addEventListener("click", () => app.use(true));
  $("perspective").addEventListener("click", () => app.use(false));
  $("fit").addEventListener("click", () => app.fit());
  $("size").addEventListener("input", (event) => app.setSize(Number(event.target.value)));
  $("budget").addEventListener("input", (event) => app.setBudget(Number(event.target.value)));
  $("shading").addEventListener("change", (event) => { app.view.shading = event.target.checked; app.material.uniforms.shading.value = Number(event.target.checked); app.dirty = true; });
  $("measure").addEventListener("click", () => app.measure(!app.measuring));
  $("card-close").addEventListener("click", () => { app.measure(false); app.clear(); });
  $("copy").addEventListener("click", async (event) => {
    await navigator.clipboard.writeText(event.target.dataset.text);
    event.target.textContent = "Copied";
  });
  $("theme").addEventListener("click", () => {
    const dark = document.documentElement.dataset.theme ? document.documentElement.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    document.documentElement.dataset.theme = dark ? "light" : "dark";
  });
  $("fold").addEventListener("click", () => fold(!$("panel").classList.contains("folded")));
  let down = null;
  canvas.addEventListener("pointerdown", (event) => { down = event.isPrimary && event.button === 0 ? { x: event.clientX, y: event.clientY } : null; });
  canvas.addEventListener("pointerup", (event) => {
    if (down && Math.hypot(event.clientX - down.x, event.clientY - down.y) < 5) app.click(event.clientX, event.clientY);
    down = null;
  });
  canvas.addEventListener("dblclick", () => { if (app.measuring) app.measuring = false, $("measure").setAttribute("aria-pressed", "false"), (canvas.style.cursor = ""); });
  addEventListener("keydown", (event) => key(app, event));
  addEventListener("resize", () => resize(app));
}

function fold(folded) {
  $("panel").classList.toggle("folded", folded);
  $("fold").setAttribute("aria-expanded", String(!folded));
}

function key(app, event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input[type=range]")) return;
  const keys = {
    t: () => app.use(true), p: () => app.use(false), f: () => app.fit(), m: () => app.measure(!app.measuring),
    "+": () => app.setSize(app.size + 0.2), "=": () => app.setSize(app.size + 0.2), "-": () => app.setSize(app.size - 0.2),
    ArrowLeft: () => app.view.pan(-1, 0), ArrowRight: () => app.view.pan(1, 0), ArrowUp: () => app.view.pan(0, 1), ArrowDown: () => app.view.pan(0, -1),
    Escape: () => { app.measure(false); app.clear(); },
  };
  modesOf(app.map).forEach((mode, i) => { keys[String(i + 1)] = () => app.colour(mode); });
  const act = keys[event.key] ?? keys[event.key.toLowerCase()];
  if (!act) return;
  event.preventDefault();
  act();
  app.dirty = true;
}

function resize(app) {
  app.view.resize(innerWidth, innerHeight, Math.min(devicePixelRatio, 2));
  app.dirty = true;
}

async function addLayers(app) {
  layerSwitch("points", "Points", app.map.points, true, (on) => { app.cloud.group.visible = on; app.dirty = true; });
  const data = await (await fetch(`${DATA}layers.json`)).json();
  const middle = new Vector3().addVectors(app.low, app.high).multiplyScalar(0.5);
  const groups = lineLayers(data, app.map.sessions, middle);
  const rows = [["trajectories", "Trajectory", true], ["loops", "Loops", true], ["objects", "What moved", false]];
  for (const [name, text, on] of rows) {
    const group = groups[name];
    group.visible = on;
    app.view.lines.add(group);
    layerSwitch(name, text, data[name].length, on, (shown) => { group.visible = shown; app.dirty = true; }, name === "objects" ? objectColours(data.objects) : []);
  }
  layerSwitch("removed", "Removed points", app.map.removed.points, false, (on) => app.showRemoved(on), classColours(app.map.removed.classes));
  app.dirty = true;
}

const answered = fetch(`${DATA}map.json`);

async function start() {
  const context = $("canvas").getContext("webgl2", { alpha: true, antialias: false, powerPreference: "high-performance" });
  if (!context) {
    say("This page draws with WebGL 2, which this browser does not offer.\n\nSwitch hardware acceleration on in its settings, or open the page in a current Chrome, Edge, Firefox or Safari.");
    return;
  }
  const answer = await answered;
  if (!answer.ok) throw new Error(await answer.text());
  const map = await answer.json();
  let app = null;
  const view = new View($("canvas"), context, () => { if (app) app.dirty = true; });
  app = new App(map, view);
  window.scanloom = app;
  describeMap(map);
  wire(app);
  fold(narrow());
  resize(app);
  app.setSize(app.size);
  app.setBudget(Number($("budget").value));
  app.colour("height");
  app.use(false);
  app.fit();
  view.renderer.setAnimationLoop(() => app.frame());
  await addLayers(app);
}

start().catch((error) => { say(`The map cannot be shown: ${error.message}`); throw error; });
