// The panel: what can be chosen, and what the colours mean.

import { CLASSES, OBJECTS, RAMPS, gradient, sessionColour } from "./palette.js";
import { modesOf } from "./cloud.js";

export const $ = (id) => document.getElementById(id);
export const number = (value) => Math.round(value).toLocaleString("en").replaceAll(",", " ");

export function element(kind, attributes = {}, ...children) {
  const made = document.createElement(kind);
  for (const [name, value] of Object.entries(attributes)) {
    if (name in made && typeof value !== "string") made[name] = value; else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

export function describeMap(map) {
  document.title = `${map.name} – Scanloom`;
  $("name").textContent = map.name;
  $("name").title = map.name;
  const across = map.max_m.map((high, i) => Math.round(high - map.min_m[i]));
  const place = map.crs ? `${map.crs} · EPSG:${map.epsg}` : "not georeferenced, local metres";
  $("crs").textContent = `${place} · ${across[0]} × ${across[1]} m · ${number(map.points)} points`;
}

export function colourButtons(map, choose) {
  $("last-mode").textContent = String(modesOf(map).length);
  modesOf(map).forEach((mode, i) => {
    const button = element("button", { role: "radio", "data-mode": mode, title: String(i + 1) }, mode[0].toUpperCase() + mode.slice(1));
    button.addEventListener("click", () => choose(mode));
    $("colours").append(button);
  });
}

export function showMode(mode, map) {
  for (const button of $("colours").children) button.setAttribute("aria-checked", String(button.dataset.mode === mode));
  const legend = $("legend");
  legend.replaceChildren();
  if (mode === "class") {
    legend.append(swatches(Object.values(map.classes).map((name) => [name, CLASSES[name]])));
  } else if (mode === "camera") {
    legend.append(element("p", { class: "quiet" }, "As cameras saw it; grey where none did."));
  } else if (mode === "session") {
    legend.append(swatches(map.sessions.map((name, i) => [name, sessionColour(i)])));
  } else {
    const bar = element("div", { class: "ramp" });
    bar.style.background = gradient(RAMPS[mode]);
    const [low, high] = mode === "height" ? map.height_m.map((h) => `${h.toFixed(1)} m`) : ["0", map.intensity[1].toPrecision(3)];
    const about = mode === "height" ? "height over the origin" : "intensity";
    legend.append(bar, element("div", { class: "ends" }, element("span", {}, low), element("span", {}, about), element("span", {}, high)));
  }
}

function swatches(entries) {
  return element("div", { class: "swatches" }, ...entries.map(([name, colour]) => {
    const mark = element("span", { class: "swatch" });
    mark.style.background = colour;
    return element("span", {}, mark, name.replaceAll("_", " "));
  }));
}

// A layer with its number of things; `colours` are pairs of a name and a colour, shown while it is on.
export function layerSwitch(name, text, count, on, change, colours = []) {
  const box = element("input", { type: "checkbox", checked: on && count > 0, disabled: count === 0, "data-layer": name });
  const legend = swatches(colours);
  legend.classList.add("under");
  legend.hidden = !colours.length || !box.checked;
  box.addEventListener("change", () => { legend.hidden = !colours.length || !box.checked; change(box.checked); });
  const label = element("label", { class: count ? "check" : "check off" }, box, element("span", {}, text), element("small", {}, count ? number(count) : "none"));
  $("layers").append(label, legend);
  return box;
}

export function showCard(head, rows, copied) {
  const body = $("card-body");
  body.replaceChildren(element("div", { class: "head" }, head));
  for (const [name, value] of rows) body.append(element("dt", {}, name), element("dd", {}, value));
  $("copy").hidden = !copied;
  $("copy").dataset.text = copied ?? "";
  $("copy").textContent = "Copy coordinates";
  $("card").hidden = false;
}

export function pointRows(about) {
  const rows = [];
  const metres = (value) => `${value.toFixed(3)} m`;
  if (about.epsg) {
    rows.push(["Easting", metres(about.easting_m)], ["Northing", metres(about.northing_m)], ["Height (ellipsoid)", metres(about.height_m)]);
    rows.push(["Latitude", `${about.latitude_deg.toFixed(8)}°`], ["Longitude", `${about.longitude_deg.toFixed(8)}°`]);
  }
  rows.push(["Map x, y, z", about.map_m.map((v) => v.toFixed(3)).join(", ")]);
  rows.push(["Class", about.class.replaceAll("_", " ")], ["Intensity", about.intensity.toPrecision(4)]);
  if (about.why) rows.push(["Left out since", about.why]);
  if (about.colour?.some((v) => v)) rows.push(["Colour", `rgb(${about.colour.join(", ")})`]);
  if (about.count !== undefined) rows.push(["Points averaged", String(about.count)]);
  if (about.session) rows.push(["Session", about.session]);
  if (about.first_ns && about.first_ns !== "0") rows.push(["First seen", time(about.first_ns)], ["Last seen", time(about.last_ns)]);
  return rows;
}

function time(ns) {
  const ms = Number(BigInt(ns) / 1_000_000n);
  return new Date(ms).toISOString().replace("T", " ").replace("Z", " UTC");
}

export const objectColours = (things) => [...new Set(things.map((thing) => thing.class))].map((name) => [name, OBJECTS[name]]);
export const classColours = (classes) => Object.values(classes).map((name) => [name, CLASSES[name]]);
