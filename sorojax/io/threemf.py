"""3MF: a zipped model that states its unit."""

import io
import zipfile
from typing import BinaryIO

import numpy as np

from sorojax.sdf import Surface

_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
_TYPES = (
    _HEAD + '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" '
    'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_LINKS = (
    _HEAD
    + '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)
_MODEL = (
    _HEAD + '<model unit="millimeter" xml:lang="en-US" '
    'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
    '<object id="1" type="model"><mesh>\n<vertices>\n'
)
_TAIL = (
    '</triangles>\n</mesh></object></resources><build><item objectid="1"/></build></model>\n'
)


def write(file: BinaryIO, surface: Surface) -> None:
    """The package, in millimetres."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as package:
        package.writestr("[Content_Types].xml", _TYPES)
        package.writestr("_rels/.rels", _LINKS)
        with package.open("3D/3dmodel.model", "w", force_zip64=True) as raw:
            model = io.BufferedWriter(raw, 1 << 20)  # type: ignore[arg-type]
            model.write(_MODEL.encode())
            np.savetxt(
                model, surface.vertices * 1e3, fmt='<vertex x="%.9g" y="%.9g" z="%.9g"/>'
            )
            model.write(b"</vertices>\n<triangles>\n")
            np.savetxt(model, surface.triangles, fmt='<triangle v1="%d" v2="%d" v3="%d"/>')
            model.write(_TAIL.encode())
            model.flush()
