# SPDX-License-Identifier: Apache-2.0
"""The tail of the normal distribution, to the same bits on every processor.

The C library's ``erfc`` fuses products and sums where the processor can, so that it ends in other
bits on aarch64 than on x86-64; its ``exp`` does not.
"""

from __future__ import annotations

import cython

if not cython.compiled:
    from math import exp, fabs

#: From here on the tail is less than the least number.
FAR = cython.declare(cython.double, 38.5)


def above(deviations: float) -> cython.double:
    """P(N(0, 1) > deviations), to a relative 3e-15 up to six deviations, 1e-13 beyond.

    exp(-x^2 / 2) times the ratio of two polynomials in x, fitted to exp(x^2 / 2) P(N(0, 1) > x)
    over x >= 0 for the least greatest relative error, 4e-16. All of their terms are positive.
    """
    x = fabs(deviations)
    if x >= FAR:
        return 0.0 if deviations > 0.0 else 1.0
    over = 4.935102247533579e-05 + x * 1.940160298828003e-06
    over = 0.004972004988295803 + x * (0.0006205945575359533 + x * over)
    over = 0.11085399056893214 + x * (0.0277063276120961 + x * over)
    over = 0.6338500637350406 + x * (0.31819811776052176 + x * over)
    over = 0.5 + x * (0.8018813915680824 + x * over)
    under = 0.00012370466831862175 + x * 4.863260662358805e-06
    under = 0.012586672953265831 + x * (0.0015604631256661244 + x * under)
    under = 0.2900853047594523 + x * (0.07099533754870209 + x * under)
    under = 1.8430063482387424 + x * (0.8639913388908103 + x * under)
    under = 2.401647343938967 + x * (2.683937463694092 + x * under)
    tail = exp(-0.5 * x * x) * over / (1.0 + x * under)
    return tail if deviations > 0.0 else 1.0 - tail
