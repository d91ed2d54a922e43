"""sorojax: a JAX-native differentiable soft-robot framework.

`import sorojax as sj`, then `sj.sdf`, `sj.mesh`, `sj.material`, `sj.fem`, `sj.rod`,
`sj.reduction`, `sj.systems`, `sj.robots`, `sj.io`, `sj.view`. Importing sets no JAX flag;
mechanics needs `jax.config.update("jax_enable_x64", True)`.
"""

from sorojax import (
    fem as fem,
    io as io,
    material as material,
    math as math,
    mesh as mesh,
    reduction as reduction,
    robots as robots,
    rod as rod,
    sdf as sdf,
    systems as systems,
    units as units,
    view as view,
)
from sorojax._cache import enable_compilation_cache as enable_compilation_cache
from sorojax._edit import replace as replace
from sorojax._progress import listen as listen, silent as silent
from sorojax.math.lie import SE2 as SE2, SE3 as SE3

__version__ = "0.1.0"
