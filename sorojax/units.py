"""SI factors for user input: write `15 * mm`, `20 * kPa`.

Every signature of sorojax is in SI units (m, kg, s, N, Pa, rad), so no kernel
contains a conversion.
"""

import math

m = 1.0
cm = 1e-2
mm = 1e-3
um = 1e-6

kg = 1.0
gram = 1e-3

s = 1.0
ms = 1e-3

N = 1.0
mN = 1e-3

Pa = 1.0
kPa = 1e3
MPa = 1e6
bar = 1e5

litre = 1e-3
ml = 1e-6

deg = math.pi / 180
