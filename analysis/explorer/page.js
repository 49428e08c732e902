/* The state, the controls that change it and the numbers that follow it. */

window.roadgym = Object.freeze({ evaluate: (p) => (p.car === "two_mass" ? evaluateTwoMass : evaluate)(p, data) });

const $ = (id) => document.getElementById(id);
const all = (selector) => [...document.querySelectorAll(selector)];

/* ---- The state: parameters by name, in the address too. ---- */

const has = Object.hasOwn;
const initial = () => structuredClone(data.view);
let state = initial();

/** Set a parameter, within its range; the bounds of the damping push each other. */
function set(name, value) {
  if (has(data.ranges, name)) {
    if (!Number.isFinite(value)) return;
    const { low, high } = data.ranges[name];
    state[name] = Math.min(Math.max(value, low), high);
    if (name === "damping_min") state.damping_max = Math.max(state.damping_max, state.damping_min);
    if (name === "damping_max") state.damping_min = Math.min(state.damping_min, state.damping_max);
  } else if (has(state.weights, name)) {
    if (Number.isFinite(value)) state.weights[name] = Math.max(value, 0);
  } else if (has(state.si_weights, name)) {
    if (Number.isFinite(value)) state.si_weights[name] = Math.max(value, 0);
  } else if (name === "coefficient") {
    set("damping", value / twoMassCar(state).damping_unit);
  } else if (name === "named" && has(data.cars, value)) {
    Object.assign(state, data.cars[value]);
  } else if (name === "car" && ["one_mass", "two_mass"].includes(value)) {
    state.car = value;
  } else if (name === "iso_class" && has(data.iso.strengths, value)) {
    state.iso_class = value;
  } else if (name === "road" && has(data.plants, value)) {
    state.road = value;
    if (!has(data.plants[value], state.speed_noise)) state.speed_noise = "none";
  } else if (name === "speed_noise" && has(data.plants[state.road], value)) {
    state.speed_noise = value;
  }
}

function readAddress() {
  state = initial();
  const given = new URLSearchParams(location.hash.slice(1));
  set("road", given.get("road")); // first, for it decides which speed noises there are
  for (const [name, value] of given) {
    set(name, ["car", "iso_class", "speed_noise"].includes(name) ? value : parseFloat(value));
  }
}

let writing = 0;
function writeAddress() { // not more often than browsers allow
  clearTimeout(writing);
  writing = setTimeout(() => {
    const { weights, si_weights: others, ...rest } = state;
    history.replaceState(null, "", `#${new URLSearchParams({ ...rest, ...weights, ...others })}`);
  }, 250);
}

/* ---- Numbers. ---- */

function showNumbers(p, result) {
  const { optimum: best, stability: rates } = result;
  const pair = (values) => (values ? values.map(text).join(", ") : "–");
  const shown = {
    cost: text(result.cost),
    best_damping: text(best && best.damping),
    best_cost: text(best && best.cost),
    mean_amplitude: text(result.mean_amplitude),
    almost_sure: pair(rates && rates.almost_sure),
    mean: pair(rates && rates.mean),
    rotation_numbers: pair(rates && rates.rotation_numbers),
    density_at_zero: text(result.marginal_density(0)),
    bound: text(result.level_bound),
  };
  for (const name of data.mean_squares) shown[name] = text(result.mean_squares && result.mean_squares[name]);
  writeNumbers(shown);

  const bound = best && (best.damping === p.damping_min ? "min" : best.damping === p.damping_max ? "max" : "");
  const named = bound ? ` = <i>D</i><sub>${bound}</sub>` : "";
  $("best-name").innerHTML = named;
  $("summary").innerHTML = best
    ? `${plantName(p)} At <i>ν</i> = ${p.frequency_ratio} the damping <b class="at"><i>D</i> = ${p.damping}</b> costs `
      + `<b class="at">${shown.cost}</b>; the best from ${p.damping_min} to ${p.damping_max}, `
      + `<b class="best"><i>D</i>${named} = ${shown.best_damping}</b>, costs <b class="best">${shown.best_cost}</b>.`
    : plantName(p);
  $("notice").textContent = obstacle(p);
  $("notice").hidden = obstacle(p) === "";
  $("python").textContent = pythonCode(p);
}

/** Write numbers by name wherever the page has a place for them. */
function writeNumbers(shown) {
  for (const element of all("[data-number]")) {
    if (has(shown, element.dataset.number)) element.textContent = shown[element.dataset.number];
  }
}

/** The numbers of the car of two masses. */
function showTwoMassNumbers(p, result) {
  const { optimum: best, damping_unit: unit, static_load: load, mean_squares: squares } = result;
  const shown = {
    si_cost: text(result.cost),
    si_best_damping: text(best && best.damping),
    si_best_coefficient: text(best && unit * best.damping),
    si_best_cost: text(best && best.cost),
    frequencies: result.frequencies.map(text).join(", "),
    static_load: text(load),
    load_share: text(Math.sqrt(squares.wheel_load) / load),
  };
  for (const name of data.signals) shown[`si_${name}`] = text(told(name, squares));
  writeNumbers(shown);
  $("ratios").innerHTML = `<i>m<sub>u</sub></i>/<i>m<sub>s</sub></i> = ${text(p.unsprung_mass / p.sprung_mass)}, `
    + `<i>k<sub>t</sub></i>/<i>k<sub>s</sub></i> = ${text(p.tyre_rate / p.spring_rate)}`;
  $("summary").innerHTML = `${twoMassName(p)} The damping <b class="at"><i>D</i> = ${p.damping}</b>, `
    + `<b class="at">${text(unit * p.damping)} N s/m</b>, gives ${shown.si_acceleration} m/s² and ${shown.si_wheel_load} N`
    + (best ? `; the best from ${p.damping_min} to ${p.damping_max} is <b class="best"><i>D</i> = ${shown.si_best_damping}</b>, `
      + `<b class="best">${shown.si_best_coefficient} N s/m</b>.` : ".");
  $("python").textContent = twoMassCode(p);
}

/* ---- Controls. ---- */

function input(attributes) {
  return Object.assign(document.createElement("input"), attributes);
}

/** Add a choice to those of the same name. */
function addPill(place, name, value, words) {
  const label = document.createElement("label"), span = document.createElement("span");
  span.textContent = words;
  label.append(input({ type: "radio", name, value }), span);
  $(place).append(label);
}

function makeControls() {
  for (const value of Object.keys(data.plants)) addPill("roads", "road", value, roadName(value));
  for (const value of Object.keys(data.cars)) addPill("cars", "named", value, value.replaceAll("_", " "));
  for (const value of Object.keys(data.iso.strengths)) addPill("classes", "iso_class", value, value);
  for (const name of data.signals) {
    const row = $("si-signals").tBodies[0].insertRow(), head = document.createElement("th");
    head.scope = "row";
    head.textContent = toldSignal(name).name;
    row.append(head);
    row.insertCell().textContent = toldSignal(name).unit;
    row.dataset.meanSquare = `si_${name}`;
  }
  for (const control of all(".control")) {
    const { name } = control.dataset, { low, high, steps } = data.ranges[name];
    const number = input({ type: "number", id: name, name, min: low, max: high, step: high > 10 ? "any" : 0.01 });
    control.append(number);
    if (control.closest(".bounds")) continue;
    const slider = input({ type: "range", name, min: 0, max: steps, step: 1 });
    slider.setAttribute("aria-label", control.textContent.replace(/\s+/g, " ").trim());
    control.append(slider);
  }
  for (const row of all("[data-mean-square]")) {
    const name = row.dataset.meanSquare;
    const value = row.insertCell(), weight = row.insertCell();
    value.className = "value";
    value.dataset.number = name;
    const number = input({ type: "number", name, min: 0, step: name.startsWith("si_") ? "any" : 0.1 });
    number.setAttribute("aria-label", `weight of ${name.replace("si_", "").replaceAll("_", " ")}`);
    weight.append(number);
    weight.className = "weight";
  }
  $("version").textContent = data.version;

  addEventListener("input", ({ target }) => {
    if (target.type === "range") set(target.name, valueAt(data.ranges[target.name], target.valueAsNumber / target.max));
    else set(target.name, target.type === "number" ? target.valueAsNumber : target.value);
    render();
  });
  addEventListener("change", () => showControls(null)); // what was typed, as it is taken
  $("controls").addEventListener("reset", (event) => {
    event.preventDefault();
    state = initial();
    render();
  });
  for (const svg of all("svg[data-drag]")) {
    const drag = (event) => {
      const { width, left, right, x } = scales[svg.id];
      const box = svg.getBoundingClientRect();
      const share = ((event.clientX - box.left) * width / box.width - left) / (right - left);
      set(svg.dataset.drag, valueAt(x, Math.min(Math.max(share, 0), 1)));
      render();
    };
    svg.addEventListener("pointerdown", (event) => {
      svg.setPointerCapture(event.pointerId);
      drag(event);
    });
    svg.addEventListener("pointermove", (event) => {
      if (event.buttons & 1) drag(event);
    });
  }
  addEventListener("resize", render);
  addEventListener("hashchange", () => {
    readAddress();
    render();
  });
}

/** Write the state into all controls but the number being typed. */
function showControls(typed = document.activeElement) {
  const coefficient = Number((state.damping * twoMassCar(state).damping_unit).toPrecision(6));
  const values = { ...state, ...state.weights, ...state.si_weights, coefficient };
  for (const element of all("input")) {
    if (element.type === "radio") {
      element.checked = element.name === "named"
        ? Object.entries(data.cars[element.value]).every(([name, value]) => name.startsWith("damping") || state[name] === value)
        : element.value === state[element.name];
      if (element.name === "speed_noise") element.disabled = !has(data.plants[state.road], element.value);
    } else {
      const value = values[element.name];
      if (element.type === "range") {
        element.value = Math.round(part(data.ranges[element.name], value) * element.max);
        element.setAttribute("aria-valuetext", value);
      } else if (element !== typed) element.value = value;
    }
  }
}

/** Show the elements with data-when for which `shown` is true. */
function showElements(shown) {
  for (const element of all("[data-when]")) element.hidden = !shown[element.dataset.when];
}

/** Which of them concern the plant of one mass. */
function concerned(p, result) {
  const noise = p.speed_noise !== "none", law = result.level_bound !== null;
  return {
    one: true,
    random: p.road !== "harmonic",
    harmonic: p.road === "harmonic",
    second_order: ["gaussian", "multiplicative"].includes(p.road),
    multiplicative: p.road === "multiplicative",
    law,
    bounded: law && result.level_bound < Infinity,
    noise,
    quiet: !noise,
    white: p.road === "harmonic" && p.speed_noise === "white",
    filtered: ["low_pass", "high_pass"].includes(p.speed_noise),
    known: result.optimum !== null,
    spectrum: result.spectral_density(1) !== null,
  };
}

function render() {
  showControls();
  if (state.car === "two_mass") {
    const result = evaluateTwoMass(state, data), known = result.optimum !== null;
    showElements({ two: true, two_known: known, weightless: !known });
    $("code").classList.toggle("wide", !known); // beside the cost
    showTwoMassNumbers(state, result);
    showTwoMassPlots(state, result);
  } else {
    const p = completed(state, data), result = evaluate(state, data);
    showElements(concerned(p, result));
    $("code").classList.toggle("wide", !(p.simulated && result.level_bound !== null)); // beside the density, if alone
    showNumbers(p, result);
    showPlots(p, result);
  }
  writeAddress();
}

makeControls();
readAddress();
render();
