// Draw a rope on a canvas: rotate, sort pieces by depth, and let near strands cut gaps into far ones.

const PALETTE = ["#94a3b8", "#38bdf8", "#34d399", "#fbbf24", "#fb7185", "#c084fc", "#f97316"];
const POSITIVE = "#2dd4bf", NEGATIVE = "#f472b6", ACCENT = "#7dd3fc";
const GROUND = "#07080c";

const colourOf = (nx) => PALETTE[nx % PALETTE.length];

// base64 of little-endian int16 in units of DATA.unit metres -> Float32Array in metres
function decoded(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const view = new DataView(bytes.buffer), out = new Float32Array(bytes.length / 2);
  for (let i = 0; i < out.length; i++) out[i] = view.getInt16(2 * i, true) * DATA.unit;
  return out;
}

// match a canvas to its size on the page in device pixels; return a cleared 2D context
function fitted(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2.5);
  const wide = Math.round(canvas.clientWidth * ratio), high = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== wide || canvas.height !== high) {
    canvas.width = wide;
    canvas.height = high;
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  return pen;
}

// side of the view in metres, large enough for the ropes in any orientation
function sideOf(...ropes) {
  let reach = 0.16;
  for (const points of ropes)
    for (let i = 0; i < points.length; i += 3)
      reach = Math.max(reach, Math.hypot(points[i], points[i + 1], points[i + 2]));
  return 2.2 * reach;
}

// orthographic projection of metres to [pixels right, pixels down, metres towards the eye]:
// rotate by `turn` about z, then by `tilt` about the horizontal axis of the screen
function projection(camera, wide, high) {
  const scale = (Math.min(wide, high) / camera.side) * camera.zoom;
  const [ct, st] = [Math.cos(camera.turn), Math.sin(camera.turn)];
  const [cl, sl] = [Math.cos(camera.tilt), Math.sin(camera.tilt)];
  const seen = (x, y, z) => {
    const right = ct * x - st * y, deep = st * x + ct * y;
    return [wide / 2 + scale * right, high / 2 - scale * (cl * deep + sl * z), cl * z - sl * deep];
  };
  return { scale, seen };
}

const topView = () => ({ turn: 0, tilt: 0, zoom: 1 }); // `side` is set by the caller

// the point at a position along the rope in beads, between two beads by linear interpolation
function pointAt(points, place) {
  const n = points.length / 3, i = Math.floor(place) % n, j = (i + 1) % n, f = place - Math.floor(place);
  return [0, 1, 2].map((k) => (1 - f) * points[3 * i + k] + f * points[3 * j + k]);
}

// closed Catmull-Rom spline through the beads, with `parts` points per bead
function smoothed(points, parts) {
  const n = points.length / 3, out = new Float32Array(3 * n * parts);
  for (let i = 0; i < n; i++) {
    const [a, b, c, d] = [(i + n - 1) % n, i, (i + 1) % n, (i + 2) % n].map((k) => 3 * k);
    for (let p = 0; p < parts; p++) {
      const t = p / parts;
      for (let k = 0; k < 3; k++) {
        const [w, x, y, z] = [points[a + k], points[b + k], points[c + k], points[d + k]];
        out[3 * (i * parts + p) + k] =
          x + 0.5 * t * (y - w + t * (2 * w - 5 * x + 4 * y - z + t * (3 * (x - y) + z - w)));
      }
    }
  }
  return out;
}

function shade(hex, light, white = 0) {
  const n = parseInt(hex.slice(1), 16);
  const level = (shift) => Math.round((((n >> shift) & 255) * (1 - white) + 255 * white) * light);
  return `rgb(${level(16)},${level(8)},${level(0)})`;
}

function drawRope(pen, points, see, fine) {
  // 2 parts keep each piece longer than the rope is thick, so its round caps stay within its neighbours
  const parts = 2, curve = smoothed(points, parts), n = curve.length / 3;
  const at = new Array(n);
  for (let i = 0; i < n; i++) at[i] = see.seen(curve[3 * i], curve[3 * i + 1], curve[3 * i + 2]);
  const order = Array.from({ length: n }, (_, i) => i);
  const depth = (i) => at[i][2] + at[(i + 1) % n][2];
  order.sort((i, j) => depth(i) - depth(j));
  const near = depth(order[n - 1]), range = Math.max(0.08, near - depth(order[0]));
  const width = Math.max(2 * DATA.radius * see.scale, 2);
  const line = (i, colour, thick, cap, aside) => {
    const [a, b] = [at[i], at[(i + 1) % n]];
    pen.beginPath();
    pen.strokeStyle = colour;
    pen.lineWidth = thick;
    pen.lineCap = cap;
    pen.moveTo(a[0] - 0.8 * aside, a[1] - aside);
    pen.lineTo(b[0] - 0.8 * aside, b[1] - aside);
    pen.stroke();
  };
  const light = (i) => 1 - (0.45 * (near - depth(i))) / range, colour = (i) => DATA.colours[Math.floor(i / parts)];
  const done = new Uint8Array(n);
  for (const i of order) {
    done[i] = 1;
    line(i, GROUND, width * 1.6, "butt", 0);
    // redraw neighbours over the gap that this piece cut into them
    const drawn = (...others) => others.map((other) => (i + other + n) % n).filter((k) => done[k]);
    for (const k of drawn(-1, 1, 0)) line(k, shade(colour(k), light(k)), width, "round", 0);
    if (fine) for (const k of drawn(-2, -1, 0, 1, 2)) line(k, shade(colour(k), light(k), 0.35), width * 0.26, "round", 0.2 * width);
  }
}

// two visits (over and under) per crossing, in the order of the walk
function visitsOf(crossings) {
  return crossings
    .flatMap(([over, under, sign], k) => [
      { place: over, label: k + 1, over: true, sign },
      { place: under, label: k + 1, over: false, sign },
    ])
    .sort((a, b) => a.place - b.place);
}

function drawCrossings(pen, points, crossings, see, lit) {
  pen.lineJoin = "round";
  pen.font = "700 13px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  const ring = crossings.length > 4 ? 8 : 11;
  crossings.forEach(([over, under, sign], k) => {
    const a = see.seen(...pointAt(points, over)), b = see.seen(...pointAt(points, under));
    const colour = sign > 0 ? POSITIVE : NEGATIVE, [x, y] = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    pen.strokeStyle = colour;
    pen.lineWidth = lit === k + 1 ? 3 : 1.6;
    pen.beginPath();
    pen.arc(x, y, lit === k + 1 ? ring + 3 : ring, 0, 2 * Math.PI);
    pen.stroke();
    if (Math.hypot(a[0] - b[0], a[1] - b[1]) > 4) {
      pen.beginPath();
      pen.moveTo(a[0], a[1]);
      pen.lineTo(b[0], b[1]);
      pen.stroke();
    }
    const middle = see.seen(0, 0, 0), away = Math.atan2(y - middle[1], x - middle[0]);
    const [right, down] = [x + (ring + 9) * Math.cos(away), y + (ring + 9) * Math.sin(away)];
    pen.strokeStyle = GROUND;
    pen.lineWidth = 5;
    pen.strokeText(String(k + 1), right, down);
    pen.fillStyle = colour;
    pen.fillText(String(k + 1), right, down);
  });
}

function drawMarker(pen, points, place, see) {
  const [x, y] = see.seen(...pointAt(points, place));
  pen.fillStyle = "rgba(255,255,255,.25)";
  pen.beginPath();
  pen.arc(x, y, 13, 0, 2 * Math.PI);
  pen.fill();
  pen.fillStyle = "#fff";
  pen.strokeStyle = GROUND;
  pen.lineWidth = 2;
  pen.beginPath();
  pen.arc(x, y, 6, 0, 2 * Math.PI);
  pen.fill();
  pen.stroke();
}

// a pull: an arrow from the bead, with length proportional to the force
function drawPull(pen, points, bead, force, see) {
  const from = pointAt(points, bead), reach = 0.16 / DATA.maxForce;
  const a = see.seen(...from), b = see.seen(...from.map((x, k) => x + reach * force[k]));
  const angle = Math.atan2(b[1] - a[1], b[0] - a[0]);
  pen.lineCap = "round";
  for (const [colour, thick] of [[GROUND, 7], ["#fff", 3]]) {
    pen.strokeStyle = colour;
    pen.lineWidth = thick;
    pen.beginPath();
    pen.moveTo(a[0], a[1]);
    pen.lineTo(b[0], b[1]);
    for (const side of [-0.5, 0.5]) {
      pen.moveTo(b[0], b[1]);
      pen.lineTo(b[0] - 11 * Math.cos(angle + side), b[1] - 11 * Math.sin(angle + side));
    }
    pen.stroke();
  }
  pen.fillStyle = "#fff";
  pen.beginPath();
  pen.arc(a[0], a[1], 5, 0, 2 * Math.PI);
  pen.fill();
}

// the outcome of an episode: a frame around the last state, and a word
function drawOutcome(pen, success) {
  const { clientWidth: wide, clientHeight: high } = pen.canvas;
  pen.strokeStyle = pen.fillStyle = success ? "#34d399" : "#fb7185";
  pen.lineWidth = 6;
  pen.strokeRect(3, 3, wide - 6, high - 6);
  pen.font = "700 26px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.textBaseline = "alphabetic";
  pen.fillText(outcomeOf(success), 18, high - 20);
}

// drag to rotate, scroll or pinch to zoom, double-click for the top view
function turnable(canvas, camera, redraw) {
  const held = new Map();
  let spread = 0;
  const apart = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  };
  const zoom = (factor) => (camera.zoom = Math.min(6, Math.max(0.4, camera.zoom * factor)));
  canvas.addEventListener("pointerdown", (event) => {
    held.set(event.pointerId, [event.clientX, event.clientY]);
    try { canvas.setPointerCapture(event.pointerId); } catch { /* a pointer made by a script */ }
    if (held.size === 2) spread = apart();
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) return;
    held.set(event.pointerId, [event.clientX, event.clientY]);
    if (held.size === 1) {
      camera.turn += (event.clientX - last[0]) / 120;
      camera.tilt = Math.min(Math.PI, Math.max(-Math.PI, camera.tilt - (event.clientY - last[1]) / 120));
    } else if (held.size === 2) {
      zoom(apart() / spread);
      spread = apart();
    }
    redraw();
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, (event) => held.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 500));
    redraw();
  }, { passive: false });
  canvas.addEventListener("dblclick", () => {
    Object.assign(camera, topView());
    redraw();
  });
}
