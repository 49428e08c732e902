"""The best state feedback of a car of one mass at one operating point, by dynamic programming; of two masses, see `white`.

The plant at one operating point is a Markov chain over control intervals; in each the damping ratio is held (zero-order hold).
Its least average cost g and relative value h satisfy Bellman's equation (D. P. Bertsekas, Dynamic Programming and Optimal
Control, vol. 2, 2012, chapter 5)

    g + h(s) = min over D of E [interval cost + h(s') | s, D],

where s is (Y, X, Z, U) on second-order roads, and (Y, X, Z) on those of first order.

Lengths here are in standard deviations of the road, times in 1/natural_frequency, as in `roadgym.compiled`.

*What is exact.* The generator maps quadratic forms of s to quadratic forms, on the Gaussian and on the bounded road alike:
drift A(D) s, noise along U of intensity 4 delta nu (1 + (1 - (Z^2 + U^2)/2)/alpha), with 1/alpha = 0 on the Gaussian road. So
the interval cost, given s and D, and the relative value h0 of the best constant damping are quadratic forms, found without
sampling. Only the rest w = h - h0 is tabulated; it is zero where feedback can gain nothing.

*The table.* (Y, X) on a rectangle, (Z, U) on a polar grid; Lagrange's cubics between. Half of it is computed: mirrored
states, (Y, X, Z, U) -> -(Y, X, Z, U), have the same value. The road's step is a rule of five points, with the exact conditional
mean and covariance; on it the car's step is regressed linearly, and what that leaves of the car's covariance, small to fifth
order in the interval, is neglected. The rule is coarse where the road forgets much in an interval: at 4 delta nu interval = 0.7
the table's own cost was 3 % off. 25 points mended that, but lowered the driven cost by 0.1 % only.

*First-order roads.* The grid of (Z, U) has two rays, on which U is zero. The damper feels the white noise of the road, so the
noise of an interval is that of three states, with a covariance that depends on D, and as large as they are. A firm damper takes
the road's noise, the softest nearly none: it is the price of D. Nearly all of it is one direction, for which the rule has 21
even points; what the car has beyond that, one direction more but for an eigenvalue of fifth order, is one standard deviation
up and down in turn, which makes the rule exact to second moments with weights that are positive. With Gauss's nine points the
table's own cost was 6 % off at nu = 3, where w is smooth in the mean alone; with these it is within 1 %. On slow roads the car
follows the level, so that (Y, X) are tabulated less a multiple of Z.

*The minimum over D.* The expected cost-to-go is found at five Chebyshev nodes of a variable that is affine in
exp(-2 D interval), the factor by which the relative velocity decays; the polynomial through them is minimised over the whole
range. Often, not always, its minimum lies at an end. The coefficients, which are smooth in s where D itself jumps, are the
feedback: they are interpolated, and minimised at the state met.

*The criterion.* What a table says of itself is not a cost. Each feedback is driven on the plant, and the table refined until
that no longer helps. Constant dampings drive over the same noise, and their exact costs take most of it out of the driven cost
(`analysis.control_variates`). Whatever the error of the table, the cost reported is that of a feedback that exists, so an upper
bound of the least cost, up to its standard error.
"""

# ruff: noqa: F403

from .driving import *
from .grid import *
from .iteration import *
from .model import *
from .policy import *
from .policy import Feedback, OptimalFeedback, Refinement, kept_files
from .road_grid import *
from .search import *
from .search import check_plant, optimal_feedback
from .white.search import WhiteRefinement, WhiteRoadFeedback, WhiteTable

__all__ = [
    "Feedback",
    "OptimalFeedback",
    "Refinement",
    "WhiteRefinement",
    "WhiteRoadFeedback",
    "WhiteTable",
    "check_plant",
    "kept_files",
    "optimal_feedback",
]
