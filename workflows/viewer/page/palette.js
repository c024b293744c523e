// Colours: ramps for heights and intensities, fixed ones for classes and sessions (readable with colour blindness).

import { Color, DataTexture } from "./vendor.js";

// Turbo (Mikhailov, Google 2019), every sixteenth entry; and greys.
const TURBO = ["#30123b", "#4145ab", "#4675ed", "#39a2fc", "#1bcfd4", "#24eca6", "#61fc6c", "#a4fc3b", "#d1e834", "#f3c63a", "#fe9b2d", "#f36315", "#d93806", "#b11901", "#7a0402"];
const VIRIDIS = ["#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725"];
const GREY = ["#2e3338", "#8d9296", "#ffffff"];

export const RAMPS = { height: TURBO, intensity: GREY, count: VIRIDIS };

export const CLASSES = {
  unlabelled: "#9aa3ab", ground: "#b28d5b", static: "#4f9fd8", dynamic: "#e8462f", airborne: "#c77bf0",
  ego: "#777777", outlier: "#f2b705", out_of_range: "#555555", changed: "#ff7fb0",
};
const CLASS_ORDER = Object.keys(CLASSES);

// Okabe and Ito, then more.
export const SESSIONS = ["#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#0072b2", "#d55e00", "#9b8afb", "#8dd35f", "#ff9da6"];
export const OBJECTS = { unknown: "#ffd23f", vehicle: "#ff4d2e", truck: "#ff8a1f", cyclist: "#36d399", person: "#f472d0" };

export function gradient(stops) {
  return `linear-gradient(90deg, ${stops.join(", ")})`;
}

export function ramp(stops) {
  const colours = stops.map((stop) => new Color().setStyle(stop, ""));
  const data = new Uint8Array(256 * 4);
  for (let i = 0; i < 256; i++) {
    const at = (i / 255) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    const colour = colours[low].clone().lerp(colours[low + 1], at - low);
    data.set([colour.r * 255, colour.g * 255, colour.b * 255, 255], i * 4);
  }
  return texture(data, 256);
}

// Colour of each class by number, or of each session.
export function table(colours) {
  const data = new Uint8Array(256 * 4);
  for (let i = 0; i < 256; i++) {
    const colour = new Color().setStyle(colours[i % colours.length], "");
    data.set([colour.r * 255, colour.g * 255, colour.b * 255, 255], i * 4);
  }
  return texture(data, 256);
}

export const classTable = () => table(CLASS_ORDER.map((name) => CLASSES[name]));
export const sessionTable = () => table(SESSIONS);
export const sessionColour = (number) => SESSIONS[number % SESSIONS.length];

function texture(data, width) {
  const made = new DataTexture(data, width, 1);
  made.needsUpdate = true;
  return made;
}
