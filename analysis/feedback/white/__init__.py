"""The best state feedback of a car of two masses, by dynamic programming in four states, once for all roads of white velocity.

On a road whose velocity is white noise of intensity S, as that of ISO 8608 is, the car's state is (tyre deflection, wheel
velocity, travel, body velocity), and nothing is remembered of the road. Lengths over sqrt(S) have one law on all such roads: so
one table, at S = 1, serves every class and every speed.

*What is exact.* The value is h = h0 + w: h0, a quadratic form, is half that of the best constant damping and half that of the
best active force (`analysis.quadratic`), and w is tabulated. The interval cost and what h0 becomes in an interval are quadratic
forms of the state, found without sampling. A first-order road has a corner, below which its spectrum levels off: then the forms
are those of the road as it is, with its level as fifth state, w is looked up at velocities relative to that with which the road
falls back to its mean, -nu Z, and only the rest, of order nu^2, is neglected.

*The table.* Lagrange's cubics on a rectangular grid of four axes; half is computed, as mirrored states have the same value.
What an interval adds to the deflection and to the wheel's velocity is a rule of five points with the exact covariance; what it
adds to the other two is small to the second order in the interval, and is left out of w alone.

*The minimum over D.* Of a variable that is affine in exp(-rate D), with the rate at which the damper alone stops the relative
velocity, w is nearly a polynomial of second degree, and the exact forms of fourth. Their sum is minimised over the whole range.

*The criterion.* As in `analysis.feedback`, a feedback is driven, on a road of so slow a corner that it is white for the car,
and tables are refined until that no longer helps.
"""
