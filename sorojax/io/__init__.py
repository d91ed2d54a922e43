"""Files: surfaces and contours in and out."""

from sorojax.io.surface import (
    export_contour as export_contour,
    export_surface as export_surface,
    import_surface as import_surface,
)
