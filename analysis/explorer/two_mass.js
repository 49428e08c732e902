/* The car of two masses on a road of ISO 8608, in SI units: a body on a spring and a damper, a wheel on its tyre.

   p has the masses, kg, and rates, N/m, `iso_class` and `kilometres_per_hour`, and `si_weights` by "si_" and the signal. The road
   is that of `roadgym.FirstOrderRoad.from_iso8608`: its velocity is white noise, but for waves longer than 100 m. Everything
   follows from one Lyapunov equation, as in roadgym/linear.py. */

/** Its damping coefficient at D = 1, N s/m; undamped frequencies of body and wheel, Hz; weight, N. */
function twoMassCar({ sprung_mass: m, unsprung_mass: u, spring_rate: k, tyre_rate: t }) {
  const sum = k / m + (k + t) / u, product = k * t / (m * u); // of the squares of both frequencies
  const high = (sum + Math.sqrt(sum ** 2 - 4 * product)) / 2;
  return {
    damping_unit: 2 * Math.sqrt(k * m),
    frequencies: [product / high, high].map((square) => Math.sqrt(square) / (2 * Math.PI)),
    static_load: 9.81 * (m + u),
  };
}

/** P of F P + P F' + g g' = 0. */
function lyapunov(F, g) {
  const size = F.length, pairs = [], place = {};
  for (let i = 0; i < size; i++) for (let j = i; j < size; j++) place[[i, j]] = place[[j, i]] = pairs.push([i, j]) - 1;
  const x = eliminate(pairs.map(([i, j]) => {
    const row = Array(pairs.length + 1).fill(0);
    for (let k = 0; k < size; k++) {
      row[place[[k, j]]] += F[i][k];
      row[place[[k, i]]] += F[j][k];
    }
    row[pairs.length] = -g[i] * g[j];
    return row;
  }));
  return F.map((_, i) => F.map((_, j) => x[place[[i, j]]]));
}

/** Mean squares of the signals, SI, at the damping ratio D; from the covariance of (z_s - z_u, z_u - z, z_s', z_u', z). */
function twoMassSquares(p, { iso }, damping = p.damping) {
  const { sprung_mass: m, unsprung_mass: u, spring_rate: k, tyre_rate: t } = p;
  const c = damping * twoMassCar(p).damping_unit, speed = p.kilometres_per_hour / 3.6;
  const corner = speed * iso.wavenumber, noise = Math.sqrt(speed * iso.strengths[p.iso_class]);
  const drift = [
    [0, 0, 1, -1, 0], [0, 0, 0, 1, corner], [-k / m, 0, -c / m, c / m, 0], [k / u, -t / u, c / u, -c / u, 0],
    [0, 0, 0, 0, -corner],
  ];
  const covariance = lyapunov(drift, [0, -noise, 0, 0, noise]);
  const signals = {
    displacement: [1, 1, 0, 0, 1],
    velocity: [0, 0, 1, 0, 0],
    acceleration: drift[2],
    travel: [1, 0, 0, 0, 0],
    relative_velocity: [0, 0, 1, -1, 0],
    wheel_displacement: [0, 1, 0, 0, 1],
    wheel_velocity: [0, 0, 0, 1, 0],
    tyre_deflection: [0, 1, 0, 0, 0],
    wheel_load: [0, t, 0, 0, 0],
  };
  return Object.fromEntries(Object.entries(signals).map(([name, row]) => [name, dot(row, applied(covariance, row))]));
}

/** The weighted sum of mean squares. */
function twoMassCost(p, squares) {
  return Object.entries(p.si_weights).reduce((sum, [name, weight]) => sum + weight * squares[name.slice(3)], 0);
}

/** Every number of the page for this car; there is no optimum without a weight. */
function evaluateTwoMass(p, known) {
  const squares = twoMassSquares(p, known);
  const cost = (damping) => twoMassCost(p, twoMassSquares(p, known, damping));
  const weighed = Object.values(p.si_weights).some((weight) => weight > 0);
  return {
    ...twoMassCar(p),
    mean_squares: squares,
    cost: twoMassCost(p, squares),
    optimum: weighed ? least(cost, p.damping_min, p.damping_max, known.search) : null,
  };
}
