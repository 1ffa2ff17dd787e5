"""Writes closed meshes in millimetres as STL and 3MF, for 3D printing. STL files state no unit, 3MF files do."""

import io
import zipfile

import numpy as np

from rig.mesh import Mesh, face_normals

STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
RELATIONS = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)


def stl_bytes(mesh: Mesh) -> bytes:
    """Encodes a mesh as a binary STL. Vertices are rounded to float32 before the normals are computed, so that normals
    and vertices agree."""
    vertices = mesh.vertices.astype("<f4")
    normals = face_normals(vertices.astype(float), mesh.faces)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.zeros(len(mesh.faces), STL_FACE)
    faces["normal"], faces["corners"] = normals / np.where(length > 0, length, 1.0), vertices[mesh.faces]
    return b"eigenhead, mm".ljust(80) + np.uint32(len(faces)).tobytes() + faces.tobytes()


def threemf_bytes(mesh: Mesh) -> bytes:
    """Encodes a mesh as 3MF core 1.3 (https://github.com/3MFConsortium/spec_core). The 3MF file contains no time, so
    that equal meshes give equal bytes."""
    text = io.StringIO()
    text.write(
        '<?xml version="1.0" encoding="UTF-8"?>\n<model unit="millimeter" xml:lang="en-US" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><metadata name="Application">eigenhead'
        '</metadata><resources><object id="1" type="model" name="head"><mesh><vertices>\n'
    )
    np.savetxt(text, mesh.vertices, fmt='<vertex x="%.4f" y="%.4f" z="%.4f"/>')
    text.write("</vertices><triangles>\n")
    np.savetxt(text, mesh.faces, fmt='<triangle v1="%d" v2="%d" v3="%d"/>')
    text.write('</triangles></mesh></object></resources><build><item objectid="1"/></build></model>\n')
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (
            ("[Content_Types].xml", TYPES),
            ("_rels/.rels", RELATIONS),
            ("3D/3dmodel.model", text.getvalue()),
        ):
            archive.writestr(zipfile.ZipInfo(name), content.encode(), compress_type=zipfile.ZIP_DEFLATED)
    return data.getvalue()
