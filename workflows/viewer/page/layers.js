// Lines over the cloud: trajectories, loops, what moved.

import {
  BoxGeometry, EdgesGeometry, Group, Line2, LineBasicMaterial, LineGeometry, LineMaterial, LineSegments, LineSegments2,
  LineSegmentsGeometry, Matrix4, Vector3,
} from "./vendor.js";
import { OBJECTS, sessionColour } from "./palette.js";

export function lineLayers(data, sessions, middle) {
  const groups = { trajectories: new Group(), loops: new Group(), objects: new Group() };
  for (const group of Object.values(groups)) group.position.copy(middle);
  for (const track of data.trajectories) {
    const number = Math.max(sessions.indexOf(track.session), 0);
    addLine(groups.trajectories, track.points, middle, "#ffffff", 5);
    addLine(groups.trajectories, track.points, middle, data.trajectories.length > 1 ? sessionColour(number) : "#ff2d78", 3);
  }
  if (data.loops.length) {
    const ends = data.loops.flatMap((loop) => [...from(loop.from, middle), ...from(loop.to, middle)]);
    const geometry = new LineSegmentsGeometry().setPositions(ends);
    groups.loops.add(new LineSegments2(geometry, lineMaterial("#12c94e", 2.5)));
  }
  for (const thing of data.objects) addObject(groups.objects, thing, middle);
  return groups;
}

function addLine(group, points, middle, colour, width) {
  if (points.length < 2) return;
  const geometry = new LineGeometry().setPositions(points.flatMap((p) => from(p, middle)));
  const line = new Line2(geometry, lineMaterial(colour, width));
  line.renderOrder = -width;
  group.add(line);
}

function addObject(group, thing, middle) {
  const colour = OBJECTS[thing.class] ?? OBJECTS.unknown;
  addLine(group, thing.path, middle, colour, 1.5);
  for (const box of thing.boxes) {
    const [length, width, height] = box.size_m;
    const edges = new EdgesGeometry(new BoxGeometry(length, width, height).translate(0, 0, height / 2));
    const lines = new LineSegments(edges, new LineBasicMaterial({ color: colour, depthTest: false }));
    const place = new Matrix4().fromArray(box.matrix);
    const at = new Vector3().setFromMatrixPosition(place).sub(middle);
    lines.matrixAutoUpdate = false;
    lines.matrix.copy(place).setPosition(at);
    group.add(lines);
  }
}

// Lines stand on top of the points, so that a track under trees is seen.
function lineMaterial(colour, width) {
  return new LineMaterial({ color: colour, linewidth: width, depthTest: false, depthWrite: false, transparent: true });
}

const from = (point, middle) => [point[0] - middle.x, point[1] - middle.y, point[2] - middle.z];
