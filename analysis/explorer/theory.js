/* The closed forms and exact series of the page, without a document: a browser and node run the same lines.

   All is in units of w1 and of the road's standard deviation. p holds the parameters by name, as `RANGES` of the Python module
   does, with `road`, `speed_noise` and `weights`, and what `completed` adds; ratio is nu = v Omega/w1. Complex numbers are [real,
   imaginary]. Equation numbers are those of Wedig (2020). The same formulas are in response.py, phase_noise.py,
   rotating_frame.py, roads.py, stability.py and optimum.py of `analysis`; what Python answers by simulation alone is null here. */

/** The parameters with what Python says of their plant, {simulated, divergent}, and of their road, {lines} or {filter} or
    nothing where there are formulas for it below. */
function completed(p, { plants, roads }) {
  const plant = plants[p.road]?.[p.speed_noise];
  if (!plant) throw new RangeError(`${p.speed_noise} speed noise is not defined on a ${p.road} road`);
  return { ...p, ...plant, ...roads[p.road] };
}

/** Mean squares over E Z^2, from P_m = E(d^m q/dt^m)^2 of q'' + 2 D q' + q = Z; Infinity where they diverge. There are none on
    simulated plants. */
function meanSquares(p, damping = p.damping, ratio = p.frequency_ratio) {
  const [p0, p1, p2, p3] = filterMeanSquares(p, damping, ratio);
  const gain = 4 * damping * damping;
  return {
    displacement: p0 + gain * p1,
    velocity: p1 + gain * p2,
    acceleration: p2 + gain * p3,
    travel: p2,
    relative_velocity: p3,
  };
}

/** P_0, ..., P_3 of the plant. */
function filterMeanSquares(p, damping, ratio) {
  if (p.lines) return sumOfWaves(p, damping, ratio);
  if (p.filter) return linearFilter(p.filter, damping, ratio);
  if (p.road === "first_order") return [...decaying(damping, 0, ratio), ratio > 0 ? Infinity : 0]; // (6)
  return secondOrder(damping, ratio, p.bandwidth);
}

/** P_0, ..., P_3 on a sum of waves: those on each of them, times its share. */
function sumOfWaves(p, damping, ratio) {
  const waves = p.lines.map(([share, k]) => (
    oneWave({ ...p, intensity: k * p.intensity }, damping, k * ratio).map((value) => share * value)));
  return waves.reduce((sum, wave) => sum.map((value, m) => value + wave[m]));
}

/** P_0, ..., P_3 on a harmonic road. */
function oneWave(p, damping, ratio) {
  if (p.speed_noise === "low_pass") return lowPass(p, damping, ratio).meanSquares;
  const sum = [0, 0, 0, Infinity];
  overRates(p, (rate, weight) => decaying(damping, ratio, rate).forEach((value, m) => { sum[m] += weight * value; }));
  if (p.speed_noise === "none") sum[3] = ratio ** 2 * sum[2]; // (3)
  return sum;
}

/** P_0, P_1, P_2 for the correlation exp(-(rate + i ratio) tau); no term is negative. */
function decaying(damping, ratio, rate) {
  const size = rate ** 2 + ratio ** 2;
  const real = 1 + 2 * damping * rate + (rate - ratio) * (rate + ratio);
  const denominator = 2 * damping * (real ** 2 + (2 * ratio * (damping + rate)) ** 2);
  const square = 4 * damping ** 2;
  return [
    (2 * damping + rate * (1 + square + 4 * damping * rate + size)) / denominator,
    (rate + (2 * damping + rate) * size) / denominator,
    (rate * (1 + 4 * damping * rate + (1 + square) * size) + 2 * damping * size ** 2) / denominator,
  ];
}

/** P_0, ..., P_3 on a second-order road: (15)-(17); no term is negative. */
function secondOrder(damping, ratio, bandwidth) {
  const mixed = bandwidth + damping * ratio, crossed = damping + bandwidth * ratio;
  const denominator = ((1 - ratio) * (1 + ratio)) ** 2 + 4 * ratio * crossed * mixed; // (15)
  const cube = ratio ** 3 / damping;
  return [
    (1 + 4 * bandwidth * ratio * crossed + bandwidth * cube) / denominator,
    ratio ** 2 / damping * crossed / denominator,
    cube * mixed / denominator,
    cube * (4 * damping * bandwidth * ratio * mixed + damping * ratio ** 3 + bandwidth) / denominator,
  ];
}

function dot(a, b) {
  let sum = 0;
  for (let i = 0; i < b.length; i++) sum += a[i] * b[i];
  return sum;
}
const applied = (matrix, vector) => matrix.map((row) => dot(row, vector));
const columns = (matrix) => matrix[0].map((_, k) => matrix.map((row) => row[k]));

/** x of (a + b F + c F^2) x = right. */
function solve(F, [a, b, c], right) {
  const across = columns(F);
  return eliminate(F.map((row, i) => [
    ...row.map((value, k) => (i === k ? a : 0) + b * value + c * dot(row, across[k])), right[i],
  ]));
}

/** x of M x = right, of the rows of [M | right], which it uses up; by elimination with pivots. */
function eliminate(rows) {
  const size = rows.length;
  for (let k = 0; k < size; k++) {
    let pivot = k;
    for (let i = k + 1; i < size; i++) if (Math.abs(rows[i][k]) > Math.abs(rows[pivot][k])) pivot = i;
    [rows[k], rows[pivot]] = [rows[pivot], rows[k]];
    for (let i = k + 1; i < size; i++) {
      const factor = rows[i][k] / rows[k][k];
      for (let j = k; j <= size; j++) rows[i][j] -= factor * rows[k][j];
    }
  }
  const x = Array(size).fill(0);
  for (let k = size - 1; k >= 0; k--) x[k] = (rows[k][size] - dot(rows[k], x)) / rows[k][k];
  return x;
}

/** P_0, ..., P_3 on a linear filter, dr = nu F r dt + sqrt(nu) G dB, Z = c r, E r r' = P.

    Where f r + white noise of intensity g drives q, stationarity of q r', q' r', q q' and q'^2 gives m = E q r, E q' r = -nu F m,
    E q'^2 = (g/2 - f nu F m)/(2 D) and E q^2 = E q'^2 + f m. Of Z itself, (1 - 2 D nu F + nu^2 F^2) m = P c' and g = 0; of its
    k-th derivative, m is that times (-nu F)^k, f is c (nu F)^k, and g is the square of sqrt(nu) c (nu F)^(k - 1) G. */
function linearFilter({ drift, noise, level, covariance, rough }, damping, ratio) {
  let m = solve(drift, [1, -2 * damping * ratio, ratio ** 2], applied(covariance, level));
  const p = [dot(level, m)], across = columns(drift);
  let f = level, g = 0;
  for (let k = 1; k <= 3; k++) {
    m = applied(drift, m).map((value) => -ratio * value); // E q' r, where the (k - 1)-th derivative drives q
    p[k] = (dot(f, m) + g / 2) / (2 * damping);
    g = ratio * columns(noise).reduce((sum, column) => sum + dot(f, column) ** 2, 0);
    f = across.map((column) => ratio * dot(f, column));
  }
  p[0] += p[1];
  if (rough) p[3] = ratio > 0 ? Infinity : 0;
  return p;
}

/** Calls add(rate, weight) for each rate at which the correlation of exp(i phi) decays without noise, with white (18) and with
    high-pass noise (30): 0; sigma^2/2; w_g times a Poisson variable of mean sigma^2/(2 w_g). */
function overRates(p, add) {
  const strength = p.intensity ** 2 / 2;
  if (p.speed_noise === "none") add(0, 1);
  else if (p.speed_noise === "white") add(strength, 1);
  else {
    const mean = strength / p.corner_frequency;
    const terms = Math.ceil(mean + 12 * Math.sqrt(mean) + 40);
    for (let n = 0, weight = Math.exp(-mean); n < terms; weight *= mean / ++n) add(p.corner_frequency * n, weight);
  }
}

/** E C/mu as [real, imaginary]: the mean of H(rate + i ratio), H(s) = (1 + 2 D s)/(1 + 2 D s + s^2); Ito's sign in (24). */
function meanAmplitude(p, damping = p.damping, ratio = p.frequency_ratio) {
  if (p.speed_noise === "low_pass") return lowPass(p, damping, ratio).amplitude;
  const sum = [0, 0];
  overRates(p, (rate, weight) => {
    const top = [1 + 2 * damping * rate, 2 * damping * ratio];
    const bottom = [top[0] + (rate - ratio) * (rate + ratio), top[1] + 2 * rate * ratio];
    const size = bottom[0] ** 2 + bottom[1] ** 2;
    sum[0] += weight * (top[0] * bottom[0] + top[1] * bottom[1]) / size;
    sum[1] += weight * (top[1] * bottom[0] - top[0] * bottom[1]) / size;
  });
  return sum;
}

const times = (a, b) => [a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]];
const plus = (...terms) => [terms.reduce((sum, t) => sum + t[0], 0), terms.reduce((sum, t) => sum + t[1], 0)];

/** Low-pass noise (25): E C/mu and P_0, ..., P_3 from the continued fraction
    X_n = [A + i ratio + n w_g + (n + 1) v X_(n+1)]^(-1), v = sigma^2 w_g/2, over functions x + y A of the matrix of free decay,
    A^2 = 2 D A - 1; see analysis/phase_noise.py. */
function lowPass(p, damping, ratio) {
  const corner = p.corner_frequency, variance = p.intensity ** 2 / 2 * corner, twice = 2 * damping;
  const fractions = []; // X_0, ..., X_3 in the end
  let xr = 0, xi = 0, yr = 0, yi = 0;
  for (let n = levels(damping, corner, variance); n >= 0; n--) {
    const next = (n + 1) * variance;
    const cr = n * corner + next * xr, ci = ratio + next * xi; // the bracket is c + s A
    const sr = 1 + next * yr, si = next * yi;
    const dr = cr * cr - ci * ci + twice * (cr * sr - ci * si) + sr * sr - si * si; // d = c^2 + 2 D c s + s^2
    const di = 2 * cr * ci + twice * (cr * si + ci * sr) + 2 * sr * si;
    const size = dr * dr + di * di;
    const tr = cr + twice * sr, ti = ci + twice * si;
    xr = (tr * dr + ti * di) / size;
    xi = (ti * dr - tr * di) / size;
    yr = -(sr * dr + si * di) / size;
    yi = -(si * dr - sr * di) / size;
    if (n < 4) fractions[n] = { x: [xr, xi], y: [yr, yi] };
  }
  const product = (a, b) => ({
    x: plus(times(a.x, b.x), times([-1, 0], times(a.y, b.y))),
    y: plus(times(a.x, b.y), times(a.y, b.x), times([twice, 0], times(a.y, b.y))),
  });
  const timesMatrix = (a) => ({ x: times([-1, 0], a.y), y: plus(a.x, times([twice, 0], a.y)) });
  const d0 = fractions[0], d1 = product(fractions[1], d0), d2 = product(fractions[2], d1), d3 = product(fractions[3], d2);
  const matrix = timesMatrix(d1);
  const first = times([-1, 0], plus(times([0, ratio], d0.y), times([variance, 0], d1.y))); // <s/N>
  const third = (part) => plus( // of T_3
    times([0, -(ratio ** 3)], d0[part]),
    times([-variance * corner, -3 * variance * ratio], matrix[part]),
    times([-3 * variance ** 2, -variance * corner * ratio], d1[part]),
    times([4 * variance ** 2 * corner, 0], d2[part]),
    times([6 * variance ** 3, 0], d3[part]),
  );
  const t3 = { x: third("x"), y: third("y") };
  const fifth = timesMatrix(timesMatrix(t3));
  return {
    amplitude: plus(times([twice, 0], first), times([-1, 0], d0.y)),
    meanSquares: [d0.x[0] / twice, first[0] / twice, t3.y[0] / twice, -fifth.y[0] / twice],
  };
}

/** Where the continued fraction starts from zero. */
function levels(damping, corner, variance) {
  const spread = Math.sqrt(variance);
  return 24 + Math.ceil(1.1 * Math.min((18 * spread / slowestDecay(damping)) ** 2, (54 * spread / corner) ** (2 / 3)));
}

/** Rate of the slower free motion: D, or D - sqrt(D^2 - 1) beyond D = 1. */
function slowestDecay(damping) {
  const above = Math.max(damping, 1);
  return Math.min(damping, 1 / (above + Math.sqrt((above - 1) * (above + 1))));
}

/** Lyapunov exponents, top and second, almost surely (41)-(43) and in mean (44), (45); rotation numbers (42), (43). */
function stability(p) {
  const slow = slowestDecay(p.damping);
  const meanShift = p.speed_noise === "white" ? -0.5 * p.intensity ** 2 : 0;
  const own = Math.sqrt(Math.max((1 - p.damping) * (1 + p.damping), 0));
  return {
    almost_sure: [-slow, -(2 * p.damping - slow)],
    mean: ["none", "white"].includes(p.speed_noise) ? [meanShift - slow, meanShift - (2 * p.damping - slow)] : null,
    rotation_numbers: [p.frequency_ratio + own, p.frequency_ratio - own],
  };
}

/** Weighted variance ratios; Infinity where a weighted one diverges. */
function costAt(p, damping, ratio) {
  const squares = meanSquares(p, damping, ratio);
  let cost = 0;
  for (const [name, weight] of Object.entries(p.weights)) if (weight > 0) cost += weight * squares[name];
  return cost;
}

/** Is there a finite cost to minimise on the plant? */
function hasCost(p) {
  const weighted = Object.keys(p.weights).filter((name) => p.weights[name] > 0);
  return !p.simulated && weighted.length > 0 && !weighted.some((name) => p.divergent.includes(name));
}

/** {damping, cost} of the best constant damping within the bounds. */
function optimum(p, search, ratio = p.frequency_ratio) {
  return least((damping) => costAt(p, damping, ratio), p.damping_min, p.damping_max, search);
}

/** {damping, cost} at which costOf(damping) is least from low to high, as analysis/optimum.py finds it: a grid even in log D, then
    ever finer ones about the least cost, and the bound itself where the cost is flat, the lower one first. */
function least(costOf, low, high, { coarse, fine, rounds }) {
  let points = Array.from({ length: coarse }, (_, i) => low * (high / low) ** (i / (coarse - 1)));
  points[coarse - 1] = high;
  let damping, cost;
  for (let round = 0; round <= rounds; round++) {
    const costs = points.map(costOf);
    const best = costs.reduce((least, value, i) => (value < costs[least] ? i : least), 0);
    damping = points[best];
    cost = costs[best];
    const left = points[Math.max(best - 1, 0)], right = points[Math.min(best + 1, points.length - 1)];
    points = Array.from({ length: fine }, (_, i) => left + (right - left) * i / (fine - 1));
  }
  for (const bound of [high, low]) {
    const atBound = costOf(bound);
    if (atBound <= cost * (1 + 4 * Number.EPSILON)) [damping, cost] = [bound, atBound];
  }
  return { damping, cost };
}

/** Shape alpha of the law of the level, (11): 0 of the arcsine law, Infinity of the Gaussian one, null where it is not known. */
function shapeOf(p) {
  if (p.lines) return p.lines.length === 1 ? 0 : null;
  if (p.filter) return p.filter.gaussian ? Infinity : null;
  return p.road === "multiplicative" ? p.shape : Infinity;
}

/** Bound of the level in standard deviations, (12); Infinity where there is none. */
const levelBound = (shape) => Math.sqrt(2 * (shape + 1));

/** Stationary density of the level, times the standard deviation; level in standard deviations. (11) integrated over the slope. */
function marginalDensity(shape, level) {
  if (shape === Infinity) return Math.exp(-level * level / 2) / Math.sqrt(2 * Math.PI);
  const bound = levelBound(shape), radius = Math.abs(level) / bound;
  const peak = halfStep(shape) / (Math.sqrt(Math.PI) * bound);
  return radius <= 1 ? peak * ((1 - radius) * (1 + radius)) ** (shape - 0.5) : 0;
}

/** Gamma(x + 1)/Gamma(x + 1/2), x >= 0: the series of F. G. Tricomi and A. Erdelyi (Pacific J. Math. 1, 1951) beyond x = 16. */
function halfStep(x) {
  if (x < 16) return halfStep(x + 1) * (x + 0.5) / (x + 1);
  const w = x + 0.25, t = 1 / (w * w);
  return Math.sqrt(w) * Math.exp(t * (1 / 64 + t * (-5 / 2048 + t * (61 / 49152 - t * 1385 / 1048576))));
}

/** Spectral density of the level in time, times w1/E Z^2: (5), and its companions; null where it is a set of lines, under speed
    noise and at rest. */
function spectralDensity(p, frequency) {
  if (p.lines || p.speed_noise !== "none" || p.frequency_ratio === 0) return null;
  const x = frequency / p.frequency_ratio;
  if (p.filter) return filterSpectrum(p.filter, x) / p.frequency_ratio;
  if (p.road === "first_order") return 2 / (p.frequency_ratio * (1 + x * x));
  return 4 * p.bandwidth / (p.frequency_ratio * (((1 - x) * (1 + x)) ** 2 + (2 * p.bandwidth * x) ** 2));
}

/** |c (i k - F)^-1 G|^2, where the inverse is -(i k + F) (k^2 + F^2)^-1. */
function filterSpectrum({ drift, noise, level }, k) {
  return columns(noise).reduce((sum, column) => {
    const y = solve(drift, [k ** 2, 0, 1], column);
    return sum + (k * dot(level, y)) ** 2 + dot(level, applied(drift, y)) ** 2;
  }, 0);
}

/** Every number of the page at one set of parameters; what has no closed form, or is not defined, is null. Of Python, `known`
    has the plants that are defined, what roads declare of themselves, and the grids that search for the optimum. */
function evaluate(parameters, known) {
  const p = completed(parameters, known), shape = shapeOf(p);
  const harmonic = p.road === "harmonic";
  return {
    mean_squares: p.simulated ? null : meanSquares(p),
    cost: p.simulated ? null : costAt(p, p.damping, p.frequency_ratio),
    optimum: hasCost(p) ? optimum(p, known.search) : null,
    mean_amplitude: harmonic ? Math.hypot(...meanAmplitude(p)) : null,
    stability: harmonic ? stability(p) : null,
    level_bound: shape === null ? null : levelBound(shape),
    marginal_density: (level) => (shape === null ? null : marginalDensity(shape, level)),
    spectral_density: (frequency) => spectralDensity(p, frequency),
  };
}
