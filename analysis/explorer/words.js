/* Numbers and sentences of the page, and the lines of Python that give the same numbers. */

const SUPERSCRIPTS = "⁰¹²³⁴⁵⁶⁷⁸⁹";
const raised = (n) => (n < 0 ? "⁻" : "") + [...String(Math.abs(n))].map((digit) => SUPERSCRIPTS[digit]).join("");

/** Five significant digits. */
function text(value) {
  if (value === null) return "–";
  if (value === Infinity) return "infinite";
  if (value === 0) return "0";
  const size = Math.abs(value);
  const [digits, exponent] = size.toExponential(4).split("e");
  return (value < 0 ? "−" : "") + (Math.abs(exponent) > 4 ? `${digits} · 10${raised(Number(exponent))}` : size.toPrecision(5));
}

/** Why there is no cost on the plant; empty where there is one. */
function obstacle(p) {
  if (p.simulated) {
    return "With noise on the speed of a random road no closed form is known, so no number is shown. Python simulates this "
      + "plant, with standard errors: run the lines below.";
  }
  const infinite = p.divergent.filter((name) => p.weights[name] > 0).map((name) => name.replace("_", " "));
  if (infinite.length > 0) return `Infinite on this plant: ${infinite.join(" and ")}. Its weight must be 0 for a best damping.`;
  return hasCost(p) ? "" : "The cost needs at least one positive weight.";
}

/** A road in words, to stand before "road". */
function roadName(kind) {
  return kind === "gaussian" ? "Gaussian" : kind.replaceAll("_", " ");
}

/** The same at the beginning of a sentence, in HTML. */
function roadTitle(kind) {
  const name = roadName(kind);
  return (name[0].toUpperCase() + name.slice(1)).replaceAll("&", "&amp;").replaceAll("<", "&lt;");
}

/** The plant and its parameters. */
function plantName(p) {
  const unit = "<i>ω</i><sub>1</sub>";
  const intensity = `<i>σ</i>/√${unit} = ${p.intensity}`;
  const filter = `${intensity}, <i>ω<sub>g</sub></i>/${unit} = ${p.corner_frequency}`;
  const road = {
    harmonic: "Harmonic road",
    first_order: "First-order road",
    gaussian: `Gaussian road of <i>δ</i> = ${p.bandwidth}`,
    multiplicative: `Multiplicative road of <i>δ</i> = ${p.bandwidth}, <i>α</i> = ${p.shape}`,
  }[p.road] ?? `${roadTitle(p.road)} road `
    + (p.lines ? `(sum of ${p.lines.length} waves)` : `(linear filter of order ${p.filter.level.length})`);
  const noise = {
    none: "no speed noise",
    white: `white speed noise of ${intensity}`,
    low_pass: `low-pass speed noise of ${filter}`,
    high_pass: `high-pass speed noise of ${filter}`,
  }[p.speed_noise];
  return `${road}, ${noise}.`;
}

/** The lines of Python that give the same numbers. */
function pythonCode(p) {
  const given = {
    harmonic: "HarmonicRoad()",
    first_order: "FirstOrderRoad()",
    gaussian: `GaussianRoad(bandwidth=${p.bandwidth})`,
    multiplicative: `MultiplicativeRoad.from_shape(shape=${p.shape}, bandwidth=${p.bandwidth})`,
  }[p.road];
  const noise = {
    none: "None",
    white: `roadgym.WhiteSpeedNoise(intensity=${p.intensity})`,
    low_pass: `roadgym.LowPassSpeedNoise(\n    intensity=${p.intensity}, corner_frequency=${p.corner_frequency}\n)`,
    high_pass: `roadgym.HighPassSpeedNoise(\n    intensity=${p.intensity}, corner_frequency=${p.corner_frequency}\n)`,
  }[p.speed_noise];
  const weights = Object.entries(p.weights).filter(([, weight]) => weight > 0).map(([name, weight]) => `"${name}": ${weight}`);
  const lines = [
    "import analysis", "import roadgym", "",
    `road = roadgym.${given ?? `ROADS.make(${JSON.stringify(p.road)})`}`,
    `speed_noise = ${noise}`,
    `plant = {"road": road, "speed_noise": speed_noise, "speed": ${p.frequency_ratio}${given ? "" : " / road.wavenumber"}}`,
    `squares = analysis.mean_squares(**plant, damping=${p.damping})`,
    "print(squares.displacement / road.variance)",
  ];
  if (hasCost(p) || (p.simulated && weights.length > 0)) {
    lines.push(
      "best = analysis.optimal_damping(", "    **plant,", `    weights={${weights.join(", ")}},`,
      `    bounds=(${p.damping_min}, ${p.damping_max}),`, ")", "print(best.damping, best.cost)",
    );
  }
  if (p.road === "harmonic") {
    lines.push(
      `mean = analysis.mean_amplitude(speed_noise, damping=${p.damping}, speed=${p.frequency_ratio})`, "print(abs(mean))",
    );
  }
  return lines.join("\n");
}

/** The car of two masses and its road. */
function twoMassName(p) {
  return `A body of ${p.sprung_mass} kg and a wheel of ${p.unsprung_mass} kg on a road of class ${p.iso_class} at `
    + `${p.kilometres_per_hour} km/h.`;
}

/** The lines of Python that give the same numbers of the car of two masses. */
function twoMassCode(p) {
  const weights = Object.entries(p.si_weights).filter(([, weight]) => weight > 0)
    .map(([name, weight]) => `"${name.slice(3)}": ${weight}`);
  const lines = [
    "import analysis", "import roadgym", "", "car = roadgym.TwoMassCar(",
    `    sprung_mass=${p.sprung_mass}, unsprung_mass=${p.unsprung_mass},`,
    `    spring_rate=${p.spring_rate}, tyre_rate=${p.tyre_rate},`, ")",
    `plant = {"road": "iso_${p.iso_class.toLowerCase()}", "car": car, "speed": ${p.kilometres_per_hour} / 3.6}`,
    `squares = analysis.mean_squares(**plant, damping=${p.damping})`,
    "print(squares.acceleration**0.5, squares.wheel_load**0.5)",
  ];
  if (weights.length > 0) {
    lines.push(
      "best = analysis.optimal_damping(", "    **plant,", `    weights={${weights.join(", ")}},`,
      `    bounds=(${p.damping_min}, ${p.damping_max}),`, ")",
      "print(best.damping, car.damping_coefficient(best.damping), best.cost)",
    );
  }
  return lines.join("\n");
}
