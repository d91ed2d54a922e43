"""sorojax: a JAX-native differentiable soft-robot framework."""

from sorojax import units as units
from sorojax._edit import replace as replace
from sorojax._progress import listen as listen, silent as silent

__version__ = "0.1.0"
