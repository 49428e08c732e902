/* The plots of the car of two masses. */

/** How people tell a signal: its name, its unit, and how many of it are one of the SI unit. */
function toldSignal(name) {
  const unit = name === "wheel_load" ? "N" : name === "acceleration" ? "m/s²" : name.endsWith("velocity") ? "m/s" : "mm";
  return { name: name.replaceAll("_", " "), unit, factor: unit === "mm" ? 1000 : 1 };
}

/** A root mean square as it is told. */
const told = (name, squares) => toldSignal(name).factor * Math.sqrt(squares[name]);

/** Ends of a linear axis about some values, a little beyond them. */
function around(values) {
  const low = Math.min(...values), high = Math.max(...values), room = 0.06 * (high - low) || 0.1 * high;
  return { low: Math.max(low - room, 0), high: high + 2 * room };
}

const OVER_DAMPING = { acceleration: "acceleration-over-damping", travel: "travel-over-damping", wheel_load: "load-over-damping" };
const AGAINST_COMFORT = { wheel_load: "load-over-acceleration", travel: "travel-over-acceleration" };
const NAMED = [0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5]; // dampings with a dot on the curve

function showTwoMassPlots(p, result) {
  const squaresAt = (damping) => twoMassSquares(p, data, damping);
  const grid = (low, high) => Array.from({ length: 121 }, (_, i) => low * (high / low) ** (i / 120));
  const x = { ...DAMPING, name: `damping ratio ${italic("D")}` }, rules = [p.damping];
  const outside = [[DAMPING.low, p.damping_min], [p.damping_max, DAMPING.high]];
  const chosen = { kind: "at", damping: p.damping, squares: result.mean_squares };
  const best = result.optimum && { kind: "best", damping: result.optimum.damping, squares: squaresAt(result.optimum.damping) };
  const marksAt = (place) => (best ? [best, chosen] : [chosen]).map((mark) => ({ kind: mark.kind, at: place(mark) }));

  const points = grid(DAMPING.low, DAMPING.high).map((damping) => ({ damping, squares: squaresAt(damping) }));
  for (const [name, id] of Object.entries(OVER_DAMPING)) {
    const { name: words, unit } = toldSignal(name), place = ({ damping, squares }) => [damping, told(name, squares)];
    const lines = [{ kind: "at", points: points.map(place) }];
    draw(id, {
      height: 190, x, y: { ...logRange(lines), name: `${words}, ${unit}` }, lines, outside, rules, marks: marksAt(place),
      label: `Root mean square of ${words} over the damping ratio: ${text(told(name, result.mean_squares))} ${unit}.`,
    });
  }

  const allowed = grid(p.damping_min, p.damping_max).map((damping) => ({ squares: squaresAt(damping) }));
  const named = NAMED.filter((damping) => damping >= p.damping_min && damping <= p.damping_max);
  for (const [name, id] of Object.entries(AGAINST_COMFORT)) {
    const { name: words, unit } = toldSignal(name);
    const place = ({ squares }) => [told("acceleration", squares), told(name, squares)];
    const curve = allowed.map(place), marks = marksAt(place), shown = [...curve, ...marks.map(({ at }) => at)];
    draw(id, {
      height: 290, x: { ...around(shown.map(([u]) => u)), name: "acceleration, m/s²" },
      y: { ...around(shown.map(([, v]) => v)), name: `${words}, ${unit}` }, lines: [{ kind: "at", points: curve }], marks,
      dots: named.map((damping) => ({ name: String(damping), at: place({ squares: squaresAt(damping) }) })),
      label: `Root mean square of ${words} over that of acceleration, for constant dampings.`,
    });
  }

  if (!best) return;
  const cost = ({ damping, squares }) => [damping, twoMassCost(p, squares)];
  const lines = [{ kind: "at", points: points.map(cost) }];
  draw("si-cost-over-damping", {
    height: 290, x, y: { ...logRange(lines), name: "cost" }, lines, outside, rules, marks: marksAt(cost),
    label: `Cost over the damping ratio, least at ${text(best.damping)}.`,
  });
}
