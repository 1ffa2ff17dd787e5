"""Files of other programs as their manuals lay them out: each projects by its own formula, each fault is named."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig.camera import Distortion
from rig.errors import InputError
from rig.formats.cameras.cameras_file import read_rig_file, write_rig_file
from rig.formats.pictures.images import write_image
from rig.messages.message import texts_of
from tests.support.changed_rigs import relensed
from tests.support.fan_rig import POINTS, fan

METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0"><chunk label="Chunk 1" enabled="true">
 <sensors next_id="1"><sensor id="0" label="unknown" type="frame"><resolution width="1000" height="800"/>
  <calibration type="frame" class="initial"><resolution width="1000" height="800"/><f>1</f></calibration>
  <calibration type="frame" class="adjusted"><resolution width="1000" height="800"/><f>1500</f><cx>12</cx><cy>-7</cy>
   <b1>3</b1><b2>0.001</b2><k1>-0.08</k1><k2>0.03</k2><k3>-0.01</k3><k4>0.0004</k4><p1>0.0004</p1><p2>-0.0007</p2>
  </calibration></sensor></sensors>
 <cameras next_id="4" next_group_id="1"><group id="0" label="Group 1" type="folder">
  <camera id="0" sensor_id="0" label="a.JPG"><transform>1 0 0 0.5 0 1 0 0 0 0 1 -9 0 0 0 1</transform></camera>
  <camera id="1" sensor_id="0" label="b.JPG"><transform>0 0 1 -9 0 1 0 0 -1 0 0 0.2 0 0 0 1</transform></camera></group>
  <camera id="2" sensor_id="0" label="c"><transform>0 0 -1 9 0 1 0 0.3 1 0 0 0 0 0 0 1</transform></camera>
  <camera id="3" sensor_id="0" label="not aligned"/></cameras>
 <transform><rotation locked="false">0 -1 0 1 0 0 0 0 1</rotation>
  <translation locked="false">0.01 0.02 0.03</translation><scale locked="true">0.1</scale></transform>
</chunk></document>"""


def test_a_metashape_export_projects_by_its_manual(tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_text(METASHAPE)
    rig = read_rig_file(tmp_path / "cameras.xml")
    assert rig.names == ("a", "b", "c")
    chunk = np.array([0.7, -0.9, 0.4])
    world_mm = 1000 * (0.1 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ chunk + [0.01, 0.02, 0.03])
    x, y = (chunk - [0.5, 0, -9])[:2] / (chunk[2] + 9)
    r2 = x * x + y * y
    radial = 1 - 0.08 * r2 + 0.03 * r2**2 - 0.01 * r2**3 + 0.0004 * r2**4
    # Metashape: P1 is of r^2 + 2 x^2 in x, P2 of the mixed product
    across = x * radial + 0.0004 * (r2 + 2 * x * x) + 2 * -0.0007 * x * y
    down = y * radial - 0.0007 * (r2 + 2 * y * y) + 2 * 0.0004 * x * y
    wanted = [500 + 12 + 1503 * across - 0.5, 400 - 7 + 1500 * down - 0.5]
    np.testing.assert_allclose(rig["a"].project(world_mm[None])[0], wanted, atol=0.02)  # k4 is fitted, b2 left out


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (("<k4>0.0004", "<k4>5"), "a.k4 bends the picture by"),
        (("<f>1500", "<f>long"), "a.f is missing or not 1 number"),
        (('type="frame"><res', 'type="spherical"><res'), "'spherical'"),
        (('sensor_id="0" label="b', 'sensor_id="7" label="b'), "b: its sensor '7' is missing"),
        (("<document", '<!DOCTYPE a [<!ENTITY x "y">]><document'), "declares entities"),
        (("</chunk>", ""), "is no XML"),
    ],
)
def test_each_fault_of_a_metashape_file_is_named(change: tuple[str, str], fault: str, tmp_path: Path) -> None:
    assert change[0] in METASHAPE
    (tmp_path / "cameras.xml").write_text(METASHAPE.replace(*change))
    with pytest.raises(InputError, match=fault):
        read_rig_file(tmp_path / "cameras.xml")


XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xcr:Version="3" xcr:DistortionModel="brown3" xcr:FocalLength35mm="45" xcr:PrincipalPointU="0.01"
 xcr:PrincipalPointV="-0.02" xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
<xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation><xcr:Position>{x} 0 -1</xcr:Position>
<xcr:DistortionCoeficients>-0.1 0.02 0 0 0 0</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"""


def test_realitycapture_sidecars_project_by_their_article(tmp_path: Path) -> None:
    for i in range(3):
        (tmp_path / f"v{i}.xmp").write_text(XMP.format(x=0.1 * i))
        write_image(tmp_path / f"v{i}.png", np.zeros((600, 800), np.uint8))
    rig = read_rig_file(tmp_path / "v0.xmp")
    x, y = -0.05, 0.1  # of a point at (50, 100, 0) mm seen by v1, 1 m away
    r2 = x * x + y * y
    radial = 1 - 0.1 * r2 + 0.02 * r2**2
    # f = 45 / 36 of the longer side; the principal point is off the middle by shares of it
    wanted = [1000 * x * radial + 400 + 8 - 0.5, 1000 * y * radial + 300 - 16 - 0.5]
    np.testing.assert_allclose(rig["v1"].project(np.array([[50.0, 100.0, 0.0]]))[0], wanted, atol=1e-9)
    (tmp_path / "v1.png").unlink()
    (tmp_path / "v2.xmp").write_text(XMP.replace("brown3", "division"))
    with pytest.raises(InputError) as refused:
        read_rig_file(tmp_path / "v0.xmp")
    assert {"v1: the size of its picture is needed" in fault.text for fault in refused.value.faults} == {True, False}
    assert any("'division'" in fault.text for fault in refused.value.faults)


def test_a_heading_turns_clockwise_and_zero_looks_down(tmp_path: Path) -> None:
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    lines += [f"v{i}.jpg,{i},0,2,{90 * i},0,0,36,0,0,0,0,0,0,0,0" for i in range(3)]
    (tmp_path / "out.csv").write_text("\n".join(lines))
    for i in range(3):
        write_image(tmp_path / f"v{i}.jpg", np.zeros((600, 800), np.uint8))
    rig = read_rig_file(tmp_path / "out.csv")
    np.testing.assert_allclose(rig["v0"].axis_world, [0, 0, -1], atol=1e-12)
    north, east = np.array([[0, 1, 0]]), np.array([[1, 0, 0]])
    up = [-camera.camera_from_world.rotation[1] for camera in rig]  # the picture's top
    np.testing.assert_allclose([up[0], up[1], up[2]], np.concatenate([north, east, -north]), atol=1e-12)


def test_blender_frames_tell_an_angle_and_no_size(tmp_path: Path) -> None:
    frames = []
    for i in range(3):
        matrix = np.eye(4)
        matrix[:3, 3] = [0.1 * i, 0, 4.0]
        frames.append({"file_path": f"./train/r_{i}", "transform_matrix": matrix.tolist()})
        write_image(tmp_path / "images" / f"r_{i}.png", np.zeros((600, 800), np.uint8))
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    rig = read_rig_file(tmp_path / "transforms.json")
    focal = 400 / np.tan(0.35)
    # at the origin, y up: half a picture's height above the middle is up by 300 / f of the depth
    point = np.array([[0.0, 4000 * 100 / focal, 0.0]])
    np.testing.assert_allclose(rig["r_0"].project(point)[0], [399.5, 299.5 - 100], atol=1e-9)
    (tmp_path / "transforms.json").write_text(
        json.dumps({"frames": [{**frames[0], "fl_x": "9", "k4": 1}, *frames[1:]]})
    )
    with pytest.raises(InputError) as refused:
        read_rig_file(tmp_path / "transforms.json")
    text = " ".join(texts_of(refused.value.faults))
    for fault in ("r_0.fl_x is '9'", "r_0.k4", "r_1 has neither fl_x nor camera_angle_x"):
        assert fault in text


def test_blender_sees_what_the_camera_sees(tmp_path: Path) -> None:
    rig = relensed(fan(), lambda k: replace(k, distortion=Distortion()))
    write_rig_file(rig, tmp_path / "cameras.py", "blender")
    script = (tmp_path / "cameras.py").read_text()
    compile(script, "cameras.py", "exec")
    for entry in json.loads(script.split('r"""')[1].split('"""')[0]):
        camera = rig[entry["name"]]
        matrix = np.array(entry["matrix_world"])
        points = (POINTS / 1000.0 - matrix[:3, 3]) @ matrix[:3, :3]
        width, height = entry["size"]
        focal = entry["lens_mm"] * width / entry["sensor_width_mm"]
        aspect = entry["pixel_aspect"][1] / entry["pixel_aspect"][0]
        across = 0.5 * width + focal * points[:, 0] / -points[:, 2] - entry["shift"][0] * width
        down = 0.5 * height - (focal * points[:, 1] / -points[:, 2] - entry["shift"][1] * width) / aspect
        np.testing.assert_allclose(np.stack([across, down], 1) - 0.5, camera.project(POINTS), atol=1e-6)


def test_a_damaged_part_of_an_opencv_yaml_is_named(tmp_path: Path) -> None:
    write_rig_file(fan(), tmp_path, "opencv-yaml")
    (tmp_path / "extri.yml").write_text("%YAML:1.0\n---\nnames: [")
    with pytest.raises(InputError, match=r"extri\.yml"):
        read_rig_file(tmp_path / "intri.yml")


@pytest.mark.parametrize("width", [".Nan", ".Inf", "0.5", "-3"])
def test_a_size_that_is_none_is_a_fault(width: str, tmp_path: Path) -> None:
    write_rig_file(fan(3), tmp_path, "opencv-yaml")
    text = (tmp_path / "intri.yml").read_text()
    (tmp_path / "intri.yml").write_text(text.replace("W_cam01: 1025", f"W_cam01: {width}"))
    with pytest.raises(InputError, match=r"cam01\.width"):
        read_rig_file(tmp_path / "intri.yml")
