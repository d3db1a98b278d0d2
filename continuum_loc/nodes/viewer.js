// Draws points and curves of the map frame (metres, z up) in perspective, to be turned and zoomed.
"use strict";

const LAYERS = [
  { key: "map", name: "prior map", colour: "#8391a8", size: 1.5, alpha: 0.6 },
  { key: "reconstruction", name: "reconstruction", colour: "#ffb454", size: 2 },
  { key: "new", name: "not in the map", colour: "#ff4d6d", size: 3 },
  { key: "truth", name: "true rings", colour: "#c3e88d", size: 12, open: true }, // the estimate shows inside
  { key: "backbone", name: "backbone", colour: "#5cc8ff", line: 5 },
  { key: "rings", name: "rings", colour: "#5cc8ff", size: 7 },
];
const NEAR = 0.02; // share of the distance nearer than which nothing is drawn

// Axes of a view from azimuth `yaw` and elevation `pitch` [rad]: to the right, upward, to the eye.
function axes(yaw, pitch) {
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return [[-sy, cy, 0], [-sp * cy, -sp * sy, cp], [cp * cy, cp * sy, sp]];
}

// Where a point lies on a canvas: [right, down, pixels per metre there]; null behind the eye.
function project(view, width, height, x, y, z) {
  const [right, up, eye] = axes(view.yaw, view.pitch);
  const [dx, dy, dz] = [x - view.centre[0], y - view.centre[1], z - view.centre[2]];
  const along = a => a[0] * dx + a[1] * dy + a[2] * dz;
  const depth = view.distance - along(eye);
  if (depth < NEAR * view.distance) return null;
  const scale = Math.min(width, height) / depth;
  return [width / 2 + scale * along(right), height / 2 - scale * along(up), scale];
}

// Centre and size of what is shown: of the map where there is one, else of all.
function bounds(shown) {
  const some = shown.map && shown.map.x.length ? [shown.map] : Object.values(shown);
  const ends = axis => {
    let [low, high] = [Infinity, -Infinity];
    for (const points of some) for (const v of points[axis]) { low = Math.min(low, v); high = Math.max(high, v); }
    return [low, high];
  };
  const box = ["x", "y", "z"].map(ends);
  if (!Number.isFinite(box[0][0])) return null;
  return { centre: box.map(([low, high]) => (low + high) / 2), size: Math.max(0.05, ...box.map(([low, high]) => high - low)) };
}

// A round length [m] that takes at most `most` pixels at `scale` pixels per metre.
function roundLength(scale, most) {
  const power = 10 ** Math.floor(Math.log10(most / scale));
  return [5, 2, 1].map(digit => digit * power).find(length => length * scale <= most);
}

function drawLayer(canvas, view, layer, points, width, height) {
  const at = k => project(view, width, height, points.x[k], points.y[k], points.z[k]);
  canvas.fillStyle = canvas.strokeStyle = layer.colour;
  canvas.globalAlpha = layer.alpha || 1;
  canvas.lineWidth = layer.line || 1.5;
  if (layer.line) canvas.beginPath();
  for (let k = 0; k < points.x.length; k++) {
    const place = at(k);
    if (place === null) continue;
    if (layer.line) canvas.lineTo(place[0], place[1]);
    else if (layer.size < 4) canvas.fillRect(place[0] - layer.size / 2, place[1] - layer.size / 2, layer.size, layer.size);
    else {
      canvas.beginPath();
      canvas.arc(place[0], place[1], layer.size / 2, 0, 2 * Math.PI);
      if (layer.open) canvas.stroke(); else canvas.fill();
    }
  }
  if (layer.line) canvas.stroke();
  canvas.globalAlpha = 1;
}

// The map's axes in a corner, and how long a length is at the centre of the view.
function drawScale(canvas, view, width, height) {
  const [right, up] = axes(view.yaw, view.pitch);
  canvas.font = "12px system-ui, sans-serif";
  canvas.lineWidth = 1.5;
  canvas.fillStyle = canvas.strokeStyle = "#8a909a";
  ["x", "y", "z"].forEach((name, k) => {
    const [u, v] = [44 + 28 * right[k], height - 44 - 28 * up[k]];
    canvas.beginPath(); canvas.moveTo(44, height - 44); canvas.lineTo(u, v); canvas.stroke();
    canvas.fillText(name, u + 3, v - 3);
  });
  const scale = Math.min(width, height) / view.distance;
  const length = roundLength(scale, 120);
  canvas.fillRect(width - 20 - length * scale, height - 20, length * scale, 2);
  canvas.fillText(`${Number(length.toPrecision(1))} m`, width - 20 - length * scale, height - 26);
}

function start() {
  const scene = document.getElementById("scene"), say = document.getElementById("say");
  const canvas = scene.getContext("2d");
  const view = { yaw: -2.4, pitch: 0.5, distance: 1, centre: [0, 0, 0], touched: false };
  const nothing = () => ({ x: [], y: [], z: [] });
  const shown = Object.fromEntries(LAYERS.map(layer => [layer.key, nothing()]));
  let waiting = false, mapVersion = -1;

  function draw() {
    waiting = false;
    const fine = globalThis.devicePixelRatio || 1, width = scene.clientWidth, height = scene.clientHeight;
    scene.width = width * fine; scene.height = height * fine;
    canvas.scale(fine, fine);
    for (const layer of LAYERS) if (!layer.hidden) drawLayer(canvas, view, layer, shown[layer.key], width, height);
    drawScale(canvas, view, width, height);
  }
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };

  function fit() {
    const found = view.touched ? null : bounds(shown);
    if (found) Object.assign(view, { centre: found.centre, distance: 1.7 * found.size });
  }

  function listen() {
    const held = new Map();
    const spread = () => { const [a, b] = [...held.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
    scene.addEventListener("pointerdown", e => { scene.setPointerCapture(e.pointerId); held.set(e.pointerId, { x: e.clientX, y: e.clientY }); });
    for (const name of ["pointerup", "pointercancel"]) scene.addEventListener(name, e => held.delete(e.pointerId));
    scene.addEventListener("pointermove", e => {
      const last = held.get(e.pointerId);
      if (!last) return;
      view.touched = true;
      const before = held.size === 2 ? spread() : 0, dx = e.clientX - last.x, dy = e.clientY - last.y;
      held.set(e.pointerId, { x: e.clientX, y: e.clientY });
      if (held.size === 2) view.distance *= before / Math.max(spread(), 1);
      else if (e.shiftKey) {
        const [right, up] = axes(view.yaw, view.pitch), metres = view.distance / Math.min(scene.clientWidth, scene.clientHeight);
        view.centre = view.centre.map((c, k) => c + metres * (dy * up[k] - dx * right[k]));
      } else {
        view.yaw -= 0.008 * dx;
        view.pitch = Math.max(-1.57, Math.min(1.57, view.pitch + 0.008 * dy));
      }
      redraw();
    });
    scene.addEventListener("wheel", e => { e.preventDefault(); view.touched = true; view.distance *= Math.exp(0.001 * e.deltaY); redraw(); }, { passive: false });
    addEventListener("resize", redraw);
  }

  function legend() {
    document.getElementById("legend").append(...LAYERS.map(layer => {
      const button = document.createElement("button"), dot = document.createElement("i");
      dot.style.background = layer.colour;
      button.append(dot, layer.name);
      button.addEventListener("click", () => { layer.hidden = !layer.hidden; button.className = layer.hidden ? "off" : ""; redraw(); });
      return button;
    }));
  }

  async function poll() {
    try {
      const state = await (await fetch("state.json")).json();
      if (state.map_version !== mapVersion) {
        shown.map = await (await fetch("map.json")).json();
        mapVersion = state.map_version;
      }
      for (const { key } of LAYERS) if (key !== "map") shown[key] = state[key];
      say.replaceChildren(...state.status.map(([level, text]) => Object.assign(document.createElement("div"),
        { className: ["ok", "warn", "bad", "bad"][level], textContent: text })));
      if (!state.status.length) say.textContent = "waiting for data";
      fit();
      redraw();
    } catch (error) { say.textContent = "the viewer node has gone"; }
    setTimeout(poll, 200);
  }

  listen();
  legend();
  poll();
}

if (typeof document === "undefined") module.exports = { axes, bounds, drawLayer, LAYERS, project, roundLength };
else start();
