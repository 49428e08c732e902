/* The plots: SVG, drawn anew at each change. */

/** Points between low and high: even ones, and more about each peak [centre, width]. */
function mesh(low, high, peaks, even = 160) {
  const points = Array.from({ length: even + 1 }, (_, i) => low + (high - low) * i / even);
  for (const [centre, width] of peaks) {
    const first = Math.asinh((low - centre) / width), last = Math.asinh((high - centre) / width);
    for (let i = 0; i <= 120; i++) points.push(centre + width * Math.sinh(first + (last - first) * i / 120));
  }
  return points.sort((a, b) => a - b);
}

/** Places of the ticks, at most about `most`: powers of ten, with 2 and 5 between them where there is room; or even steps. */
function ticks(low, high, logarithmic, most) {
  const found = [];
  if (logarithmic) {
    const decades = Math.log10(high / low);
    const digits = decades < most / 3 ? [1, 2, 5] : [1];
    const stride = Math.ceil(decades / most);
    for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k++) {
      if (k % stride === 0) found.push(...digits.map((digit) => Number(`${digit}e${k}`)));
    }
  } else {
    const raw = (high - low) / most, power = 10 ** Math.floor(Math.log10(raw));
    const step = power * [1, 2, 5, 10].find((digit) => digit * power >= raw * (1 - 1e-9));
    for (let k = Math.ceil(low / step); k * step <= high * (1 + 1e-9); k++) found.push(Number((k * step).toPrecision(6)));
  }
  return found.filter((value) => value >= low * (1 - 1e-9) && value <= high * (1 + 1e-9));
}

/** End of a linear axis from zero. */
const highest = (lines) => 1.1 * Math.max(...lines.flatMap((line) => line.points.map((point) => point[1])));

/** Ends of a logarithmic axis: 1, 2 or 5 times a power of ten, five decades apart at most. */
function logRange(lines) {
  const values = lines.flatMap((line) => line.points.map((point) => point[1])).filter((value) => value > 0);
  if (values.length === 0) values.push(1); // the car at rest
  const high = Math.max(...values), low = Math.max(Math.min(...values), high * 1e-5);
  const ends = [-1, 0, 1].flatMap((shift) => [1, 2, 5].map((digit) => [digit, shift]));
  const end = (value, [digit, shift]) => Number(`${digit}e${Math.floor(Math.log10(value)) + shift}`);
  return {
    low: ends.map((place) => end(low, place)).findLast((value) => value <= low),
    high: ends.map((place) => end(high, place)).find((value) => value > high),
    logarithmic: true,
  };
}

function tickText(value) {
  const [digits, exponent] = value.toExponential().split("e");
  if (Math.abs(exponent) < 4) return String(value).replace("-", "−");
  return `${digits === "1" ? "" : `${digits}·`}10${raised(Number(exponent))}`;
}

/** Where a value lies on an axis or a slider from 0 to 1, and back. */
function part({ low, high, logarithmic }, value) {
  return logarithmic ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
}

function valueAt({ low, high, logarithmic }, share) {
  return Number((logarithmic ? low * (high / low) ** share : low + (high - low) * share).toPrecision(3));
}

const scales = {}; // of each plot, to turn a place of the pointer into a value

/** Draw lines {kind, points}, marks {kind, at}, small dots with a name {name, at}, rules {x} and shaded ranges `outside` into the
    plot with the id, no higher than wide. */
function draw(id, { height: most, x, y, lines, marks = [], dots = [], rules = [], outside = [], area = null, label }) {
  const svg = document.getElementById(id);
  const width = Math.min(Math.max(svg.clientWidth, 300), 640), height = Math.min(most, width);
  const left = 46, right = width - 8, top = 24, bottom = height - 36;
  const place = (axis, from, to) => (value) => Math.min(Math.max(from + part(axis, value) * (to - from), -9999), 9999);
  const px = place(x, left, right), py = place(y, bottom, top);
  scales[id] = { width, left, right, x };
  const path = (points) => points.map(([u, v], i) => `${i ? "L" : "M"}${px(u).toFixed(2)},${py(v).toFixed(2)}`).join("");
  const box = (from, to) => `class="outside" x="${from}" y="${top}" width="${to - from}" height="${bottom - top}"`;
  const words = (u, v, anchor, content) => `<text x="${u}" y="${v}" text-anchor="${anchor}">${content}</text>`;
  const parts = [`<clipPath id="${id}-clip"><rect ${box(left, right)}/></clipPath>`];
  for (const [from, to] of outside) {
    const a = Math.max(px(from), left), b = Math.min(px(to), right);
    if (b > a) parts.push(`<rect ${box(a, b)}/>`);
  }
  for (const value of ticks(x.low, x.high, x.logarithmic, Math.round((right - left) / 55))) {
    parts.push(`<path class="grid" d="M${px(value)},${top}V${bottom}"/>`);
    parts.push(words(px(value), bottom + 16, "middle", tickText(value)));
  }
  for (const value of ticks(y.low, y.high, y.logarithmic, Math.max(Math.round((bottom - top) / 36), 2))) {
    parts.push(`<path class="grid" d="M${left},${py(value)}H${right}"/>`);
    parts.push(words(left - 6, py(value) + 4, "end", tickText(value)));
  }
  parts.push(`<path class="frame" d="M${left},${top}V${bottom}H${right}"/><g clip-path="url(#${id}-clip)">`);
  if (area) parts.push(`<path class="area" d="${path(area)}"/>`);
  for (const value of rules) parts.push(`<path class="rule" d="M${px(value)},${top}V${bottom}"/>`);
  for (const { kind, points } of lines) parts.push(`<path class="line ${kind}" d="${path(points)}"/>`);
  parts.push("</g>");
  const dot = ({ name, at: [u, v] }) => (
    `<circle cx="${px(u)}" cy="${py(v)}" r="2.6"/>${words(px(u) + 7, py(v) - 6, "start", name)}`);
  parts.push(`<g class="dots">${dots.map(dot).join("")}</g>`);
  for (const { kind, at: [u, v] } of marks) {
    if (py(v) < top - 1 || py(v) > bottom + 1) continue;
    parts.push(`<circle class="mark ${kind}" cx="${px(u)}" cy="${py(v)}" r="5.5"/>`);
  }
  const names = words(left - 34, 11, "start", y.name) + words(right, bottom + 32, "end", x.name);
  parts.push(`<g class="names">${names}</g>`);
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.setAttribute("aria-label", label);
  svg.innerHTML = parts.join("");
}

const italic = (letter) => `<tspan font-style="italic">${letter}</tspan>`;
const SPEED = { ...data.ranges.frequency_ratio, name: `frequency ratio ${italic("ν")}` };
const DAMPING = data.ranges.damping;
const DRAWN = { coarse: 33, fine: 9, rounds: 2 }; // of the best damping, as far as a line shows it

/** [rate, wavenumber] at which what makes the road decays and turns, over the angle: there its spectrum may have peaks. */
function tones(p) {
  if (p.lines) return p.lines.map(([, k]) => [0, k]);
  if (p.filter) return p.filter.poles;
  return [p.road === "first_order" ? [1, 0] : [p.bandwidth, 1]];
}

function showPlots(p, result) {
  const sharp = data.ranges.damping.low;
  const resonances = tones(p).map(([, k]) => 1 / k).filter((value) => value <= SPEED.high);
  const speeds = mesh(SPEED.low, SPEED.high, resonances.map((value) => [value, sharp]));
  const ratio = p.frequency_ratio, best = result.optimum;
  const outside = [[DAMPING.low, p.damping_min], [p.damping_max, DAMPING.high]];
  if (best) {
    const over = (damping) => speeds.map((value) => [value, costAt(p, damping, value)]);
    const moving = mesh(SPEED.low, SPEED.high, [], 120).filter((value) => value > 0); // at rest every damping is as good
    const envelope = moving.map((value) => [value, optimum(p, DRAWN, value)]);
    const lines = [
      { kind: "thin", points: over(p.damping_min) },
      { kind: "thin", points: over(p.damping_max) },
      { kind: "at", points: over(p.damping) },
      { kind: "best", points: envelope.map(([value, found]) => [value, found.cost]) },
    ];
    draw("cost-over-speed", {
      height: 290, x: SPEED, y: { ...logRange(lines), name: "cost" }, lines, rules: [ratio],
      marks: [{ kind: "best", at: [ratio, best.cost] }, { kind: "at", at: [ratio, result.cost] }],
      label: `Cost over the frequency ratio: ${text(result.cost)} at the chosen damping, ${text(best.cost)} at the best one.`,
    });
    draw("best-over-speed", {
      height: 150, x: SPEED, y: { ...DAMPING, name: `best ${italic("D")}` }, rules: [ratio],
      lines: [{ kind: "best", points: envelope.map(([value, found]) => [value, found.damping]) }],
      marks: [{ kind: "best", at: [ratio, best.damping] }],
      label: `Best damping over the frequency ratio: ${text(best.damping)} at the chosen one.`,
    });

    const points = Array.from({ length: 161 }, (_, i) => DAMPING.low * (DAMPING.high / DAMPING.low) ** (i / 160))
      .map((damping) => [damping, costAt(p, damping, ratio)]);
    const curve = [{ kind: "at", points }];
    draw("cost-over-damping", {
      height: 440, x: { ...DAMPING, name: `damping ratio ${italic("D")}` }, y: { ...logRange(curve), name: "cost" },
      lines: curve, outside, rules: [p.damping],
      marks: [{ kind: "best", at: [best.damping, best.cost] }, { kind: "at", at: [p.damping, result.cost] }],
      label: `Cost over the damping ratio, least at ${text(best.damping)}.`,
    });
  }
  if (p.road === "harmonic") {
    const over = (plant) => speeds.map((value) => [value, Math.hypot(...meanAmplitude(plant, p.damping, value))]);
    const lines = [{ kind: "thin", points: over({ ...p, speed_noise: "none" }) }, { kind: "at", points: over(p) }];
    draw("amplitude-over-speed", {
      height: 290, x: SPEED, y: { low: 0, high: highest(lines), name: `|E ${italic("C")}|/${italic("μ")}` },
      lines, rules: [ratio],
      marks: [{ kind: "at", at: [ratio, result.mean_amplitude] }],
      label: `Mean amplitude over the frequency ratio: ${text(result.mean_amplitude)} at the chosen one.`,
    });
  }

  if (result.spectral_density(1) !== null) {
    const peaks = tones(p).map(([rate, k]) => [ratio * k, ratio * rate / 2]);
    const road = mesh(0, 5, [[1, sharp], ...peaks]).map((value) => [value, result.spectral_density(value)]);
    const gain = (value) => Math.hypot(...meanAmplitude(p, p.damping, value)) ** 2; // |H|^2, without noise
    const lines = [
      { kind: "thin", points: road },
      { kind: "at", points: road.map(([value, density]) => [value, density * gain(value)]) },
    ];
    draw("spectra", {
      height: 290, x: { low: 0, high: 5, name: `frequency ${italic("ω")}/${italic("ω")}₁` },
      y: { ...logRange(lines), name: "spectral density" }, lines,
      label: "Spectral densities of the road's level and of the displacement over the frequency.",
    });
  }

  if (result.level_bound === null) return;
  const bound = result.level_bound;
  const end = Math.max(3.6, bound < Infinity ? 1.08 * bound : 0);
  const shares = Array.from({ length: 241 }, (_, i) => i / 120 - 1);
  const level = (share) => (bound < Infinity ? bound * Math.sin(Math.PI / 2 * share) : end * share); // dense at a bound
  const law = shares.map(level).map((value) => [value, result.marginal_density(value)]);
  if (bound < Infinity) {
    law.unshift([-end, 0], [-bound, 0]);
    law.push([bound, 0], [end, 0]);
  }
  const normal = shares.map((share) => [end * share, marginalDensity(Infinity, end * share)]);
  const lines = [...(bound < Infinity ? [{ kind: "thin", points: normal }] : []), { kind: "at", points: law }];
  const index = `<tspan font-style="italic" font-size="9" dy="3">Z</tspan>`;
  draw("density", {
    height: 290, x: { low: -end, high: end, name: `level ${italic("z")}/${italic("σ")}${index}` },
    y: { low: 0, high: Math.min(1, highest(lines)), name: "density" },
    lines, area: law,
    rules: bound < Infinity ? [-bound, bound] : [],
    label: `Density of the road's level: ${text(result.marginal_density(0))} at zero, in standard deviations.`,
  });
}
