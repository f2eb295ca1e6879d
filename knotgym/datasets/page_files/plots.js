// Plots: timeline of an episode, histogram, rejections.

const INK = "#e8ebf2", DIM = "#8b93a7", RULE = "#262c3a";

function label(pen, text, x, y, colour = DIM, align = "left") {
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = align;
  pen.textBaseline = "middle";
  pen.fillStyle = colour;
  pen.fillText(text, x, y);
}

function rule(pen, x0, y0, x1, y1, colour = RULE, wide = 1) {
  pen.strokeStyle = colour;
  pen.lineWidth = wide;
  pen.beginPath();
  pen.moveTo(x0, y0);
  pen.lineTo(x1, y1);
  pen.stroke();
}

const TIME_LEFT = 84;

// crossings of every state (green where the code is the goal's), rewards, and the current step
function drawTimeLine(canvas, episode, now) {
  const pen = fitted(canvas), wide = canvas.clientWidth, high = canvas.clientHeight;
  const last = episode.code.length - 1, most = Math.max(1, ...episode.nx);
  const x = (t) => TIME_LEFT + ((wide - TIME_LEFT - 10) * t) / Math.max(1, last);
  const top = 14, bottom = high - 52, y = (nx) => bottom - ((bottom - top) * nx) / most;
  for (let nx = 0; nx <= most; nx += Math.ceil(most / 4)) {
    rule(pen, TIME_LEFT, y(nx), wide - 10, y(nx));
    label(pen, String(nx), TIME_LEFT - 8, y(nx), DIM, "right");
  }
  label(pen, "crossings", 0, y(most) + (bottom - top) / 2);
  label(pen, "reward", 0, high - 32);
  episode.code.forEach((code, t) => {
    const end = t < last ? x(t + 1) : x(t) + 3, goal = episode.codes[code] === episode.goal;
    pen.fillStyle = goal ? "#34d39955" : "#7dd3fc1f";
    pen.fillRect(x(t), y(episode.nx[t]), end - x(t), bottom - y(episode.nx[t]) + 1);
    rule(pen, x(t), y(episode.nx[t]), end, y(episode.nx[t]), goal ? "#34d399" : ACCENT, 2);
    if (t && episode.nx[t] !== episode.nx[t - 1])
      rule(pen, x(t), y(episode.nx[t - 1]), x(t), y(episode.nx[t]), ACCENT, 1);
  });
  rule(pen, TIME_LEFT, high - 32, wide - 10, high - 32);
  const largest = Math.max(1e-9, ...episode.rewards.map(Math.abs));
  episode.rewards.forEach((reward, t) => {
    pen.fillStyle = reward > 0 ? "#34d399" : NEGATIVE;
    const tall = (12 * Math.abs(reward)) / largest, thick = Math.max(2, Math.min(8, x(1) - x(0) - 1));
    pen.fillRect(x(t + 1) - thick / 2, high - 32 - (reward > 0 ? tall : 0), thick, tall);
  });
  const every = Math.max(1, Math.round(last / 8));
  for (let t = 0; t <= last; t += every) label(pen, String(t), x(t), high - 8, DIM, "center");
  rule(pen, x(now), 4, x(now), high - 18, "#fff", 1.5);
  pen.fillStyle = "#fff";
  pen.beginPath();
  pen.arc(x(now), 5, 4, 0, 2 * Math.PI);
  pen.fill();
}

// the step at a position on the timeline
function stepAt(canvas, episode, clientX) {
  const box = canvas.getBoundingClientRect(), last = episode.code.length - 1;
  const share = (clientX - box.left - TIME_LEFT) / (box.width - TIME_LEFT - 10);
  return Math.min(last, Math.max(0, share * last));
}

function drawHistogram(canvas, values, low, high_) {
  const pen = fitted(canvas), wide = canvas.clientWidth, high = canvas.clientHeight;
  const from = Math.min(...values), span = Math.max(...values) - from || 1, bins = new Array(40).fill(0);
  for (const value of values) bins[Math.min(39, Math.floor((40 * (value - from)) / span))]++;
  const most = Math.max(...bins);
  bins.forEach((count, k) => {
    const left = from + (span * k) / 40, inside = left + span / 40 >= low && left <= high_;
    pen.fillStyle = inside ? ACCENT : RULE;
    const tall = count ? Math.max(2, (high * count) / most) : 0;
    pen.fillRect((wide * k) / 40, high - tall, wide / 40 - 1, tall);
  });
}

// bars of rejections by nx and reason
function drawRejected(canvas, rejected) {
  const rows = Object.entries(rejected).flatMap(([nx, reasons]) =>
    Object.entries(reasons).sort((a, b) => b[1] - a[1]).map(([reason, count]) => [nx, reason, count]));
  canvas.style.height = `${rows.length * 24 + 8}px`;
  const pen = fitted(canvas), wide = canvas.clientWidth, most = Math.max(...rows.map((row) => row[2]));
  pen.font = "11px system-ui, sans-serif";
  const left = 54 + Math.max(...rows.map((row) => pen.measureText(row[1]).width));
  rows.forEach(([nx, reason, count], k) => {
    const y = 24 * k + 14;
    label(pen, `nx ${nx}`, 0, y, colourOf(Number(nx)));
    label(pen, reason.replaceAll("_", " "), 42, y, INK);
    pen.fillStyle = colourOf(Number(nx));
    pen.fillRect(left, y - 6, Math.max(2, ((wide - left - 60) * count) / most), 12);
    label(pen, String(count), left + 8 + Math.max(2, ((wide - left - 60) * count) / most), y);
  });
}
