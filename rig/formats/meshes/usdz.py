"""Writes the parts of a scene as USDZ, with the library OpenUSD (optional dependency group ``usd``)."""

import importlib
import tempfile
import zipfile
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.colour_space import linear_from_srgb
from rig.errors import EigenheadError, how_to_install
from rig.formats.meshes.glb import ROUGHNESS
from rig.formats.meshes.scene import Part, Scene, Skin, quaternion
from rig.messages.message import compose

ROOT = "/person"
SUFFIXES = {"image/jpeg": ".jpg", "image/png": ".png"}  # what USDZ may hold
ALIGNED = 64  # files of the package begin at multiples of so many bytes (https://openusd.org/release/spec_usdz.html)
HEADER = 30  # bytes of a zip entry's header before its name
PADDING = 4  # bytes of the header of a zip entry's padding field


class NoUsd(EigenheadError):
    """Reports that OpenUSD is not installed."""

    def __init__(self) -> None:
        super().__init__(compose("usd-not-installed", remedy=how_to_install("usd")))


def check_usd() -> None:
    """Raises NoUsd if OpenUSD is not installed."""
    try:
        from pxr import Usd  # noqa: F401
    except ImportError:
        raise NoUsd from None


def scene_usdz_bytes(scene: Scene) -> bytes:
    """Encodes a scene's parts as meshes of one USDZ file in metres, y up, with a UsdPreviewSurface or vertex colours.
    Translation and orientation of a part are separate operations. Equal scenes give equal bytes. Raises NoUsd."""
    check_usd()
    images = {f"{part.name}{SUFFIXES[part.skin.mime]}": part.skin.image for part in scene.parts if part.skin}
    with tempfile.TemporaryDirectory() as scratch:
        layer = Path(scratch) / "head.usdc"
        write_layer(layer, scene)
        return pack_usdz({"head.usdc": layer.read_bytes()} | images)


def openusd_module(name: str) -> Any:
    """Imports a module of OpenUSD as Any, because its type stubs are incomplete."""
    return importlib.import_module(f"pxr.{name}")


def write_layer(path: Path, scene: Scene) -> None:
    """Writes the scene's parts to ``path`` (.usdc). The scene's texture files must lie in the same folder."""
    Gf, Usd, UsdGeom = map(openusd_module, ("Gf", "Usd", "UsdGeom"))
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
    for part in scene.parts:
        vertices, place = scene.about(part)
        shape = _write_mesh(stage, part, vertices)
        if part.skin is None:
            colours = np.full(vertices.shape, 200, np.uint8) if part.mesh.colours is None else part.mesh.colours
            shown = shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
            shown.Set(vectors("Vec3fArray", linear_from_srgb(colours / 255.0)))
        else:
            _write_skin(stage, shape, part, part.skin)
        if scene.pivots_mm:
            x, y, z, w = quaternion(place.rotation).tolist()
            shape.AddTranslateOp().Set(Gf.Vec3d(*(place.translation / 1000.0).tolist()))
            shape.AddOrientOp().Set(Gf.Quatf(w, x, y, z))
    stage.GetRootLayer().Save()


def vectors(kind: str, values: np.ndarray) -> Any:
    """Converts values to an OpenUSD array of the type ``kind``: Vec3fArray, Vec2fArray or IntArray."""
    dtype = np.int32 if kind == "IntArray" else np.float32
    return getattr(openusd_module("Vt"), kind).FromNumpy(np.ascontiguousarray(values, dtype))


def _write_mesh(stage: Any, part: Part, vertices: Float[np.ndarray, "v 3"]) -> Any:
    UsdGeom, points, faces = openusd_module("UsdGeom"), vertices / 1000.0, part.mesh.faces
    shape = UsdGeom.Mesh.Define(stage, f"{ROOT}/{part.name}")
    shape.CreatePointsAttr(vectors("Vec3fArray", points))
    shape.CreateFaceVertexCountsAttr(vectors("IntArray", np.full(len(faces), 3)))
    shape.CreateFaceVertexIndicesAttr(vectors("IntArray", faces.ravel()))
    shape.CreateExtentAttr(vectors("Vec3fArray", np.stack([points.min(axis=0), points.max(axis=0)])))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateNormalsAttr(vectors("Vec3fArray", part.unit_normals()))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return shape


def _write_skin(stage: Any, shape: Any, part: Part, skin: Skin) -> None:
    Gf, Sdf, UsdGeom, UsdShade = map(openusd_module, ("Gf", "Sdf", "UsdGeom", "UsdShade"))
    kinds, path = Sdf.ValueTypeNames, f"{ROOT}/{part.name}_skin"
    coordinates = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("st", kinds.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    coordinates.Set(vectors("Vec2fArray", skin.uv * (1, -1) + (0, 1)))  # USD's v is upwards
    coordinates.SetIndices(vectors("IntArray", (part.mesh.faces if skin.faces is None else skin.faces).ravel()))
    material = UsdShade.Material.Define(stage, path)
    surface, reader, picture = (
        UsdShade.Shader.Define(stage, f"{path}/{name}") for name in ("surface", "coordinates", "texture")
    )
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", kinds.Float).Set(ROUGHNESS)
    surface.CreateInput("metallic", kinds.Float).Set(0.0)
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set("st")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(f"{part.name}{SUFFIXES[skin.mime]}"))
    picture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    for wrap in ("wrapS", "wrapT"):
        picture.CreateInput(wrap, kinds.Token).Set("clamp")
    picture.CreateInput("fallback", kinds.Float4).Set(Gf.Vec4f(0.5, 0.5, 0.5, 1.0))
    picture.CreateInput("st", kinds.Float2).ConnectToSource(reader.CreateOutput("result", kinds.Float2))
    surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(picture.CreateOutput("rgb", kinds.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)


def pack_usdz(files: dict[str, bytes]) -> bytes:
    """Packs files into a zip without compression or times. As USDZ requires, each file begins at a multiple of 64
    bytes, and the USD layer is first."""
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
