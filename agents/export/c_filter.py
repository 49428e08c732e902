"""The Kalman filter in front of a policy as C99, `roadgym.kalman`: in double precision, as single would ruin its covariance.

Python keeps Phi(D) and Q(D) as series at each operating point. In C they are found anew at each call, as Python finds the nodes
of its series: Taylor's series of the equations over a part of the interval, then doubled. The equations are polynomials of D,
speed and bandwidth, of which few terms are not zero: these are the constants, so the filter is exact at every operating point.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from roadgym.kalman import KalmanFilter
from roadgym.kalman_kernel import KNOWN
from roadgym.roads.linear import TERMS
from roadgym.task import OPERATING_POINT, SATURATION

from ..errors import AgentError

FloatArray = npt.NDArray[np.float64]

ROUNDING = 1e-12  # share of the largest value of an entry that is none
FACTORS = (1.0, 2.0)  # of frequency ratio and bandwidth x in what is observed, x/(1 + x)

TEXT = """\
/* The Kalman filter: what road, car and sensors are at an operating point are sums of terms value D^d ratio^r bandwidth^b. */
enum {{ OWN = {own}, STATES = {states}, MEASURED = {measured}, TOLD = {told}, WAITING = {waiting} }};
enum {{ DRIFT = 0, INTENSITY = OWN * OWN, ROWS = 2 * OWN * OWN, LATE = ROWS + MEASURED * STATES,
       MEANS = LATE + {lates} * OWN, START = MEANS + TOLD * OWN, MODEL = START + STATES * STATES }};

typedef struct {{
    double value;
    unsigned short place;
    unsigned char powers[3];
}} filter_term;

static const filter_term filter_terms[{count}] = {{
{terms}
}};
static const double noise[MEASURED] = {{{noise}}};
static const int columns[MEASURED] = {{{columns}}}, late[MEASURED] = {{{late}}}, period[MEASURED] = {{{period}}};

static void find_model(int count, double damping, const double *point, double *m)
{{
    const double of[3] = {{damping, point[0], point[1]}};
    for (int i = 0; i < MODEL; i++) m[i] = 0.0;
    for (int k = 0; k < count; k++) {{
        double value = filter_terms[k].value;
        for (int j = 0; j < 3; j++)
            for (int p = 0; p < filter_terms[k].powers[j]; p++) value *= of[j];
        m[filter_terms[k].place] += value;
    }}
}}

/* c = a b, or a b' */
static void multiply(int size, const double *a, const double *b, int transposed, double *c)
{{
    for (int i = 0; i < size; i++) {{
        for (int k = 0; k < size; k++) {{
            double sum = 0.0;
            for (int j = 0; j < size; j++) sum += a[i * size + j] * (transposed ? b[k * size + j] : b[j * size + k]);
            c[i * size + k] = sum;
        }}
    }}
}}

/* x(interval) = phi x(0) + w, spread = Cov w */
static void transition(const double *drift, const double *intensity, double *phi, double *spread)
{{
    double part = {interval}, size = 0.0, term[OWN * OWN], gain[OWN * OWN], moved[OWN * OWN], grown[OWN * OWN];
    int doublings = 0;
    for (int i = 0; i < OWN * OWN; i++) size += fabs(drift[i]);
    for (; part * size > 0.25; part *= 0.5) doublings++;
    for (int i = 0; i < OWN * OWN; i++) {{
        phi[i] = term[i] = i % (OWN + 1) == 0 ? 1.0 : 0.0;
        spread[i] = 0.0;
        gain[i] = intensity[i] * part;
    }}
    for (int order = 1; order < {orders}; order++) {{
        multiply(OWN, term, drift, 0, moved);
        multiply(OWN, drift, gain, 0, grown);
        for (int i = 0; i < OWN; i++) {{
            for (int k = 0; k < OWN; k++) {{
                const int e = i * OWN + k;
                term[e] = moved[e] * (part / order);
                phi[e] += term[e];
                spread[e] += gain[e];
                gain[e] = (grown[e] + grown[k * OWN + i]) * (part / (order + 1));
            }}
        }}
    }}
    for (; doublings > 0; doublings--) {{
        multiply(OWN, phi, spread, 0, moved);
        multiply(OWN, moved, phi, 1, grown);
        multiply(OWN, phi, phi, 0, moved);
        for (int i = 0; i < OWN * OWN; i++) {{
            spread[i] += grown[i];
            phi[i] = moved[i];
        }}
    }}
}}

/* Over an interval: mean and covariance of car and road, of biases, which stay, and of what is measured and not told yet. */
static void predict(const double *m,{old} double *mean, double *covariance)
{{
    double phi[OWN * OWN], spread[OWN * OWN], pull[STATES * STATES], moved[STATES], turned[STATES * STATES];
    transition(m + DRIFT, m + INTENSITY, phi, spread);
    for (int i = 0; i < STATES * STATES; i++) pull[i] = 0.0;
    for (int i = 0; i < OWN * OWN; i++) pull[i / OWN * STATES + i % OWN] = phi[i];
{pull}    for (int i = 0; i < STATES; i++) {{
        moved[i] = 0.0;
        for (int k = 0; k < STATES; k++) moved[i] += pull[i * STATES + k] * mean[k];
    }}
    for (int i = 0; i < STATES; i++) mean[i] = moved[i];
    multiply(STATES, pull, covariance, 0, turned);
    multiply(STATES, turned, pull, 1, covariance);
    for (int i = 0; i < OWN * OWN; i++) covariance[i / OWN * STATES + i % OWN] += spread[i];
    for (int i = 0; i < STATES; i++) /* rounding must not make it less symmetric from call to call */
        for (int k = 0; k < i; k++) covariance[k * STATES + i] = covariance[i * STATES + k];
}}

/* Take up one measurement y = row x + noise; what is no number tells nothing. */
static void correct(double y, const double *row, double variance, double *mean, double *covariance)
{{
    double gain[STATES], possible = variance, error = y;
    for (int i = 0; i < STATES; i++) {{
        gain[i] = 0.0;
        for (int k = 0; k < STATES; k++) gain[i] += covariance[i * STATES + k] * row[k];
        error -= row[i] * mean[i];
        variance += row[i] * gain[i];
        possible += row[i] * row[i] * fmax(covariance[i * (STATES + 1)], 1e-9);
    }}
    if (!(variance > {known} * possible) || !isfinite(error)) return;
    for (int i = 0; i < STATES; i++) {{
        mean[i] += gain[i] * (error / variance);
        for (int k = 0; k < STATES; k++) covariance[i * STATES + k] -= gain[i] * gain[k] / variance;
    }}
}}

/* What is told of the state, after what was observed. */
static void filtered(int begun, double *mean, double *covariance, double *in_force, int *wait, double command,
                     const float *observation, float *told)
{{
    double m[MODEL], point[2] = {{{point}}};
{observed}    if (begun) {{
{before}        for (int k = WAITING; k > 0; k--) in_force[k] = in_force[k - 1];
        in_force[0] = fmin(fmax(command, {low}), {high});
{levels}        find_model({running}, in_force[WAITING], point, m);
        predict(m,{late_rows} mean, covariance);
    }} else {{
        for (int k = 0; k <= WAITING; k++) in_force[k] = {low};
        for (int j = 0; j < MEASURED; j++) wait[j] = 1;
        find_model({count}, {low}, point, m);
        for (int i = 0; i < STATES; i++) mean[i] = 0.0;
        for (int i = 0; i < STATES * STATES; i++) covariance[i] = m[START + i];
    }}
    for (int j = 0; j < MEASURED; j++) {{
        if (--wait[j] > 0) continue;
        wait[j] = begun ? period[j] : late[j] + period[j];
        correct((double)observation[columns[j]], m + ROWS + j * STATES, noise[j], mean, covariance);
    }}
    for (int j = 0; j < TOLD; j++) {{
        double sum = 0.0;
        for (int i = 0; i < OWN; i++) sum += m[MEANS + j * OWN + i] * mean[i];
        told[j] = (float)fmin(fmax(sum, -{saturation}), {saturation});
    }}
{tell}}}"""

OBSERVED = """\
    {{
        const double share = (double)observation[{column}];
        point[{k}] = fmin(fmax(share / (1.0 - share) / {factor}, {low}), {high});
    }}
"""
LATE_ROWS = """\
        double old[MODEL];
        find_model({running}, in_force[WAITING], point, old);
"""


@dataclasses.dataclass(frozen=True)
class CFilter:
    """A filter in C.

    Attributes:
        text: definitions of constants and functions, of which ``filtered`` is called.
        states, waiting, measured: how many states have a mean and a covariance, commands wait, and signals are measured.
        told: numbers that it tells.
        constant, variable: bytes of its constants, and on the stack.
    """

    text: str
    states: int
    waiting: int
    measured: int
    told: int
    constant: int
    variable: int


def equations(known: KalmanFilter, points: FloatArray, damping: float) -> list[FloatArray]:
    """What a filter knows of car, road and sensors at operating points and a damping, shape (points, ...) each.

    Drift, intensity of the noise, rows of what is measured, of what is told late, and of what is told, covariance at the start.
    """
    model, system = known.model(points), known.system(points, np.array([damping]))
    rows, late = (each[:, 0] + damping * each[:, 1] for each in (model.rows, model.delayed))
    count, size = len(points), len(system.states)
    drift = np.broadcast_to(system.drift, (count, 1, size, size))[:, 0]
    intensity = system.noise @ np.swapaxes(system.noise, -1, -2)
    return [drift, np.broadcast_to(intensity, (count, 1, size, size))[:, 0], rows, late, model.told, model.start]


def terms_of(known: KalmanFilter) -> tuple[list[tuple[float, int, tuple[int, ...]]], list[tuple[int, ...]]]:
    """(value, place, powers) of each term of the equations, the place in all of them one after the other, and their shapes.

    They are of second order at most in each of D, frequency ratio and bandwidth.

    Raises:
        AgentError: others.
    """
    nodes = [np.array([-1.0, 0.0, 1.0])]  # of D, and whole numbers too of what varies, so that the fit rounds nothing
    nodes += [np.array([1.0, 2.0, 3.0] if low < high else [low]) for low, high in known.ranges]

    def values(points: FloatArray, damping: float) -> FloatArray:
        return np.concatenate([part.reshape(len(points), -1) for part in equations(known, points, damping)], axis=1)

    points = np.array(list(itertools.product(*nodes[1:])))
    coefficients = np.stack([values(points, damping) for damping in nodes[0].tolist()])
    coefficients = coefficients.reshape(*(len(at) for at in nodes), -1)
    largest = np.abs(coefficients).max(axis=(0, 1, 2))
    for axis, at in enumerate(nodes):
        fit = np.round(2 * np.linalg.inv(np.vander(at, increasing=True))) / 2  # as it is
        coefficients = np.moveaxis(np.tensordot(fit, coefficients, (1, axis)), 0, axis)
    coefficients[np.abs(coefficients) <= ROUNDING * largest] = 0.0
    between = [0.3 * high + 0.7 * low for low, high in ((-1.0, 1.0), *known.ranges)]
    powers = (np.vander([x], len(at), increasing=True)[0] for x, at in zip(between, nodes, strict=True))
    built = np.einsum("a,b,c,abce->e", *powers, coefficients)
    if np.any(np.abs(built - values(np.array([between[1:]]), between[0])[0]) > 100 * ROUNDING * largest):
        raise AgentError(
            "cannot export a Kalman filter whose equations are no polynomials of speed and bandwidth, as after a warm-up: "
            "fix both, or do without the warm-up"
        )
    places = sorted(zip(*(axis.tolist() for axis in np.nonzero(coefficients)), strict=True), key=lambda place: place[3])
    shapes = [part.shape[1:] for part in equations(known, points[:1], 0.0)]
    return [(float(coefficients[place]), place[3], place[:3]) for place in places], shapes


def numbers(values: Sequence[float] | npt.NDArray[np.float64]) -> str:
    """Literals that double precision reads as the same numbers."""
    return ", ".join(repr(float(value)) for value in values)


def c_filter(known: KalmanFilter) -> CFilter:
    """The filter.

    Raises:
        AgentError: a filter that cannot be written here, in one line that says why, and what can be.
    """
    task = known.task
    if len(known.bank) > 1:
        raise AgentError(
            "cannot export a bank of Kalman filters over what is hidden: "
            "fix speed and bandwidth, or have them observed, and let no car vary"
        )
    if known.parts > 1:
        raise AgentError(
            "cannot export a Kalman filter behind a valve that moves within a control interval: "
            "levels and a delay of whole intervals can be"
        )
    terms, shapes = terms_of(known)
    (own, _), (measured, states) = shapes[0], shapes[2]
    lates, told = shapes[3][0], shapes[4][0]
    start = sum(int(np.prod(shape)) for shape in shapes[:-1])
    running = sum(place < start for _, place, _ in terms)
    valve = task.valve.numbers(task.control_interval, task.car.natural_frequency)
    low, high = (repr(float(end)) for end in task.damping_range)
    observed, tell = "", ""
    for k, (column, factor, ends) in enumerate(zip(known.seen, FACTORS, known.ranges, strict=True)):
        if column is not None:
            words = {"column": column, "k": k, "factor": factor, "low": repr(float(ends[0])), "high": repr(float(ends[1]))}
            observed += OBSERVED.format(**words)
    moving = [name for name in known.full.signals if name not in OPERATING_POINT]
    for place, name in enumerate(known.full.signals[len(moving) :], len(moving)):
        k = OPERATING_POINT.index(name)
        tell += f"    told[{place}] = (float)({FACTORS[k]} * point[{k}] / (1.0 + {FACTORS[k]} * point[{k}]));\n"
    pull, row = "", own
    biases = states - own - int(known.late.sum())
    if biases:
        pull += f"    for (int i = OWN; i < OWN + {biases}; i++) pull[i * (STATES + 1)] = 1.0;\n"
        row += biases
    for j, lag in enumerate(known.late[known.late > 0].tolist()):
        pull += f"    for (int k = 0; k < OWN; k++) pull[{row * states} + k] = old[{j} * OWN + k];\n"
        pull += f"    for (int i = {row + 1}; i < {row + lag}; i++) pull[i * STATES + i - 1] = 1.0;\n" if lag > 1 else ""
        row += lag
    levels = valve["valve_levels"]
    step = repr((task.damping_range[1] - task.damping_range[0]) / (levels - 1)) if levels else ""
    text = TEXT.format(
        own=own,
        states=states,
        measured=measured,
        told=told,
        waiting=int(valve["valve_late"]),
        lates=lates,
        count=len(terms),
        running=running,
        terms=",\n".join(f"    {{{value!r}, {place}, {{{', '.join(map(str, power))}}}}}" for value, place, power in terms),
        noise=numbers(known.noise),
        columns=", ".join(map(str, known.columns)),
        late=", ".join(map(str, known.late.tolist())),
        period=", ".join(map(str, known.period.tolist())),
        interval=repr(known.interval),
        orders=TERMS,
        known=KNOWN,
        old=" const double *old," if lates else "",
        pull=pull,
        point=numbers(known.bank[0]),
        observed=observed,
        before=LATE_ROWS.format(running=running) if lates else "",
        late_rows=" old + LATE," if lates else "",
        low=low,
        high=high,
        levels=f"        in_force[0] = {low} + {step} * rint((in_force[0] - {low}) / {step});\n" if levels else "",
        saturation=SATURATION,
        tell=tell,
    )
    size = start + states**2
    return CFilter(
        text=text,
        states=states,
        waiting=int(valve["valve_late"]),
        measured=measured,
        told=len(known.full.signals),
        constant=16 * len(terms) + 20 * measured,
        variable=8 * (size * (1 + bool(lates)) + 6 * own**2 + 2 * states**2 + 2 * states),
    )
