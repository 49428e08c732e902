"""The paper reproduced: W. V. Wedig, "Applied in Non-Linear Vehicle Road Dynamics", ENOC 2020, what it has right and what not.

- `rotating_frame` and `stability`: its moment equations, exponents and rotation numbers, right and as printed;
- `euler_maruyama` and `exponents`: the same by simulation, as theory's witness;
- `figures`: figures 2-14, drawn again with their data;
- `errata`: what the print has wrong, each with a number that shows it; ERRATA.md says it in words.
"""
