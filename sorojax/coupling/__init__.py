"""Rods and solids in one problem: rods that stand on the face of a solid."""

from sorojax._arguments import check_package as _check_package
from sorojax.coupling.mounted import MountedRod, MountWrench, mount_wrench, mounted_rod

__all__ = ["MountWrench", "MountedRod", "mount_wrench", "mounted_rod"]

_check_package(__name__)
