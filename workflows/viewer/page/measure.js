// Picked points and measured lines, drawn over the picture.

import { Vector3 } from "./vendor.js";

const SVG = "http://www.w3.org/2000/svg";

export class Overlay {
  constructor(svg, view) {
    this.svg = svg;
    this.view = view;
    this.picked = null;
    this.line = [];
  }

  // Of the measured line: length in space, on the plane, and difference of heights.
  get lengths() {
    let space = 0, plane = 0;
    for (let i = 1; i < this.line.length; i++) {
      space += this.line[i].distanceTo(this.line[i - 1]);
      plane += Math.hypot(this.line[i].x - this.line[i - 1].x, this.line[i].y - this.line[i - 1].y);
    }
    const rise = this.line.length > 1 ? this.line.at(-1).z - this.line[0].z : 0;
    return { space, plane, rise };
  }

  draw() {
    this.svg.replaceChildren();
    if (this.picked) {
      const at = this.view.project(this.picked);
      if (at) for (const kind of ["halo", "pick"]) this.add("circle", { cx: at.x, cy: at.y, r: 9, class: kind });
    }
    const corners = this.line.map((point) => this.view.project(point));
    for (const kind of ["halo", ""]) {
      for (let i = 1; i < corners.length; i++) {
        const [a, b] = [corners[i - 1], corners[i]];
        if (a && b) this.add("polyline", { points: `${a.x},${a.y} ${b.x},${b.y}`, class: kind });
      }
    }
    for (const corner of corners) if (corner) this.add("circle", { cx: corner.x, cy: corner.y, r: 5, class: "corner" });
    for (let i = 1; i < this.line.length; i++) {
      const middle = new Vector3().addVectors(this.line[i], this.line[i - 1]).multiplyScalar(0.5);
      const at = this.view.project(middle);
      if (at) this.add("text", { x: at.x, y: at.y - 9 }, `${this.line[i].distanceTo(this.line[i - 1]).toFixed(2)} m`);
    }
  }

  add(kind, attributes, text = "") {
    const made = document.createElementNS(SVG, kind);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.textContent = text;
    this.svg.append(made);
  }
}
