"""Writes USDZ of a textured mesh, through OpenUSD (the extra ``usd``)."""

import importlib
import tempfile
import zipfile
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from rig.errors import EigenheadError, how_to_install
from rig.formats.meshes.glb import ROUGHNESS
from rig.mesh import Mesh
from rig.messages.message import compose

ALIGNED = 64  # files of the package begin at multiples of so many bytes (https://openusd.org/release/spec_usdz.html)
HEADER = 30  # bytes of a zip entry's header before its name
PADDING = 4  # bytes of the header of a zip entry's padding field


class NoUsd(EigenheadError):
    """Reports that the extra ``usd`` is not installed."""

    def __init__(self) -> None:
        super().__init__(compose("usd-not-installed", remedy=how_to_install("usd")))


def check_usd() -> None:
    """Raises NoUsd if OpenUSD is not installed."""
    try:
        from pxr import Usd  # noqa: F401
    except ImportError:
        raise NoUsd from None


def usdz_bytes(
    mesh: Mesh,
    *,
    normals: Float[np.ndarray, "v 3"],
    uv: Float[np.ndarray, "n 2"],
    faces_uv: Int[np.ndarray, "f 3"],
    image: bytes,
    suffix: str,
) -> bytes:
    """Returns one mesh, y up, metres, in a UsdPreviewSurface. The same input is the same bytes. Raises NoUsd.

    Args:
        mesh: head frame, mm.
        normals: unit, of its vertices.
        uv: texture coordinates, v downwards; USD's is upwards.
        faces_uv: of each corner of each face.
        image: encoded.
        suffix: ".jpg" or ".png".
    """
    check_usd()
    texture = f"texture{suffix}"
    with tempfile.TemporaryDirectory() as scratch:
        layer = Path(scratch) / "head.usdc"
        _write_layer(layer, mesh, normals, uv, faces_uv, texture)
        return package({"head.usdc": layer.read_bytes(), texture: image})


def openusd_module(name: str) -> Any:
    """Imports a module of OpenUSD as Any, because its type stubs are incomplete."""
    return importlib.import_module(f"pxr.{name}")


def new_stage(path: Path, root: str) -> Any:
    """Returns a new layer, y up, in metres, with one root."""
    Usd, UsdGeom = map(openusd_module, ("Usd", "UsdGeom"))
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, root).GetPrim())
    return stage


def define_mesh(stage: Any, name: str, mesh: Mesh, normals: Float[np.ndarray, "v 3"]) -> Any:
    """Returns a new mesh of triangles of a layer, from one in millimetres."""
    UsdGeom, Vt = map(openusd_module, ("UsdGeom", "Vt"))
    shape = UsdGeom.Mesh.Define(stage, name)
    points = np.ascontiguousarray(mesh.vertices / 1000.0, np.float32)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces, np.int32).ravel()))
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, np.float32)))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return shape


def _write_layer(
    path: Path, mesh: Mesh, normals: np.ndarray, uv: np.ndarray, faces_uv: np.ndarray, texture: str
) -> None:
    Gf, Sdf, UsdGeom, UsdShade, Vt = map(openusd_module, ("Gf", "Sdf", "UsdGeom", "UsdShade", "Vt"))

    stage = new_stage(path, "/head")
    shape = define_mesh(stage, "/head/mesh", mesh, normals)
    coordinates = UsdGeom.PrimvarsAPI(shape).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    )
    coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv * (1, -1) + (0, 1), np.float32)))
    coordinates.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces_uv, np.int32).ravel()))

    skin = UsdShade.Material.Define(stage, "/head/skin")
    surface = UsdShade.Shader.Define(stage, "/head/skin/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(ROUGHNESS)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    reader = UsdShade.Shader.Define(stage, "/head/skin/coordinates")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    picture = UsdShade.Shader.Define(stage, "/head/skin/texture")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(texture))
    picture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    picture.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set("clamp")
    picture.CreateInput("wrapT", Sdf.ValueTypeNames.Token).Set("clamp")
    picture.CreateInput("fallback", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(0.5, 0.5, 0.5, 1.0))
    picture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    )
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
        picture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    )
    skin.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(skin)
    stage.GetRootLayer().Save()


def package(files: dict[str, bytes]) -> bytes:
    """Returns a zip without compression and times, whose files begin at multiples of 64 bytes; the USD layer comes
    first."""
    data = BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name)
            start = data.tell() + HEADER + len(name) + PADDING
            padding = -start % ALIGNED
            entry.extra = (0x1986).to_bytes(2, "little") + padding.to_bytes(2, "little") + bytes(padding)
            entry.CRC, entry.file_size = zlib.crc32(content), len(content)
            archive.writestr(entry, content)
    return data.getvalue()
