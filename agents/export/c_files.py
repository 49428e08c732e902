"""The files of an agent in C99: header, source, and a check with test vectors, which a driven plant gave."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

import roadgym
from roadgym.task import Task
from roadgym.vector import QuarterCarVectorEnv

from ..agent import Agent
from ..evaluation import drive
from ..records import Purpose, stream_seed
from .c_printer import BYTES, CPrinter, array, number
from .program import given
from .stages import Array, observe, program_of, signal_table

CARS, STEPS = 16, 32  # of the test vectors
LARGEST_DIFFERENCE = 1e-6  # over the damping range's upper end, by which an answer may differ from that of the agent in Python

HEADER = """\
/* {name}: the damping ratio of a semi-active damper, from what is measured; exported from a trained agent by roadgym {version}.
 *
 * Call {call} once every {interval:g} s with the signals below, and hold the damping ratio until the next call.
 *
 * {NAME}_SIGNALS numbers, in this order:
 *   signal                  unit    scale, in that unit
{table}
 *
 * {name}_observe() makes observations, which the agent takes, of what is measured in these units:
 * measured/scale, kept within +-20; for speed and bandwidth x/(1 + x) with x = measured/scale.{units}
 *
 * The damping ratio lies within [{low:g}, {high:g}] whatever is measured.{filter}
 *
 * C99 and its math.h alone; no memory is allocated, no global is written: any number of dampers may call it at once.
 * {constant} bytes of constants, at most about {variable} bytes on the stack{memory}.
 */
#ifndef {NAME}_H
#define {NAME}_H

#define {NAME}_SIGNALS {signals}

#ifdef __cplusplus
extern "C" {{
#endif

/* Observations of what is measured. */
void {name}_observe(const float measured[{NAME}_SIGNALS], float observation[{NAME}_SIGNALS]);

{declarations}

#ifdef __cplusplus
}}
#endif

#endif
"""

FILTERED = """
 *
 * It drives by a Kalman filter, which takes each answer to be what was commanded: where something else was, write that into
 * state->commanded[0] before the next call. An observation that is NaN counts as not measured."""

PLAIN = """\
/* The damping ratio for an observation. */
float {name}_damping(const float observation[{NAME}_SIGNALS]);"""

REMEMBERING = """\
/* What is remembered from one call to the next; one for each damper. */
typedef struct {{
{fields}
    int begun;
}} {name}_state;

/* Forget what was: at the start of a drive. */
void {name}_init({name}_state *state);

/* The damping ratio for an observation, which is remembered. */
float {name}_step({name}_state *state, const float observation[{NAME}_SIGNALS]);"""

CHECK = """\
/* Holds {name}.c against what the agent answered in Python.
 *
 * cc -std=c99 -O2 -o {name}_check {name}_check.c {name}.c -lm && ./{name}_check
 */
#include <math.h>
#include <stdio.h>

#include "{name}.h"
#include "{name}_vectors.h"

int main(void)
{{
    double worst = 0.0;
{state}    for (int k = 0; k < VECTORS; k++) {{
{begin}        const double difference = fabs((double){call} - (double)answers[k]) / {high};
        if (!(difference <= worst)) worst = difference;
{command}    }}
    printf("%d vectors, largest difference %.2g of the firmest damping: %s\\n", VECTORS, worst,
           worst <= {tolerance:g} ? "passed" : "FAILED");
    return worst <= {tolerance:g} ? 0 : 1;
}}
"""


SOURCE = """\
/* See {name}.h. */
#include "{name}.h"

#include <math.h>

{constants}

void {name}_observe(const float measured[{NAME}_SIGNALS], float observation[{NAME}_SIGNALS])
{{
{observe}
}}

{function}
"""

PLAIN_SOURCE = """\
float {name}_damping(const float observation[{NAME}_SIGNALS])
{{
{step}
}}"""

REMEMBERING_SOURCE = """\
void {name}_init({name}_state *state)
{{
    state->begun = 0;
}}

float {name}_step({name}_state *state, const float observation[{NAME}_SIGNALS])
{{
{step}
}}"""

VECTORS = """\
/* {cars} drives of {steps} steps each, one after the other. */
#define VECTORS {count}

static const float observations[VECTORS][{signals}] = {{
{rows}
}};

static const float answers[VECTORS] = {answers};
"""


def vectors(agent: Agent) -> tuple[Array, Array]:
    """Observations, shape (CARS, STEPS, signals), of cars that the agent drives, and its answers, shape (CARS, STEPS)."""
    envs = QuarterCarVectorEnv(CARS, max_episode_steps=None, threads=1, **agent.description["environment"])
    steps = list(itertools.islice(drive(agent, envs, stream_seed(0, Purpose.EXPORT), {}), STEPS))
    return np.stack([step[0] for step in steps], axis=1), np.stack([step[1][:, 0] for step in steps], axis=1)


def units(task: Task) -> str:
    """How rates are to be told where the car tells all in metres, and what the damping ratio is in N s/m."""
    lines = ""
    if all(signal.unit == "m" for signal in task.car.motion.signals.values()):
        lines += (
            f"\n * All in m: a velocity is one in m/s over {task.car.natural_frequency:.9g} rad/s, an acceleration one in m/s^2"
            "\n * over the square of that."
        )
    if task.car.damping_unit:
        lines += f"\n * The damping ratio times {task.car.damping_unit:.9g} is the damping coefficient in N s/m."
    return lines


def c_files(agent: Agent, name: str) -> dict[str, str]:
    """The files by their names, of which ``name`` is the stem, and the beginning of each name in them.

    Raises:
        AgentError: an agent that cannot be written here, in one line that says why.
    """
    task, size, printer, program = agent.task, len(agent.task.signals), CPrinter(), program_of(agent)
    words: dict[str, Any] = {"name": name, "NAME": name.upper(), "version": roadgym.__version__, "signals": size}
    copy = f"for (int i = 0; i < {size}; i++) observation[i] = {{0}}[i];"
    words["observe"] = printer.body([observe(task, given("measured", (size,)))], copy)
    fields = sorted(program.memory.fields.items(), key=lambda field: field[1].kind != "double")  # without gaps between them
    places = {field: f"{{{k}}}" for k, field in enumerate(program.memory.fields, 1)}
    end = [f"for (int i = 0; i < {x.size}; i++) state->{field}[i] = {places[field]}[i];" for field, x in fields]
    words["step"] = printer.body(program.results, "\n".join([*end, *["state->begun = 1;"] * bool(fields), "return {0}[0];"]))
    declarations, text, call = PLAIN, PLAIN_SOURCE, f"{name}_damping("
    memory = begin = state = command = ""
    if fields:
        words["fields"] = "\n".join(f"    {x.kind} {field}[{x.size}];" for field, x in fields)
        declarations, text, call = REMEMBERING, REMEMBERING_SOURCE, f"{name}_step(&state, "
        begin, state = f"        if (k % {STEPS} == 0) {name}_init(&state);\n", f"    {name}_state state;\n"
        taken, align = 4 + sum(BYTES[x.kind] * x.size for _, x in fields), BYTES[fields[0][1].kind]
        memory = f", {-(-taken // align) * align} bytes to remember"
    if agent.filter is not None:
        command = "        state.commanded[0] = answers[k]; /* which is what the car was told */\n"
    low, high = task.damping_range
    header = HEADER.format(
        call=f"{call.partition('(')[0]}()",
        interval=task.control_interval,
        table="\n".join(f" *   {signal:<24}{unit:<8}{scale:.9g}" for signal, unit, scale in signal_table(task)),
        low=low,
        high=high,
        units=units(task),
        filter="" if agent.filter is None else FILTERED,
        memory=memory,
        declarations=declarations.format(**words),
        **printer.bytes,
        **words,
    )
    check = {"state": state, "begin": begin, "call": f"{call}observations[k])", "high": high, "tolerance": LARGEST_DIFFERENCE}
    seen, answers = vectors(agent)
    rows = ",\n".join("    {" + ", ".join(map(number, row)) + "}" for row in seen.reshape(-1, size))
    known = {"cars": CARS, "steps": STEPS, "count": answers.size, "rows": rows, "answers": array(answers)}
    source = SOURCE.format(constants="\n".join(printer.constants.values()), function=text.format(**words), **words)
    return {
        f"{name}.h": header,
        f"{name}.c": source,
        f"{name}_check.c": CHECK.format(**check, command=command, **words),
        f"{name}_vectors.h": VECTORS.format(**known, **words),
    }
