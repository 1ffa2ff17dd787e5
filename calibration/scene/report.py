"""Writes the report of a calibration from a scene: one self-contained HTML page."""

from html import escape
from pathlib import Path

from calibration.report import STYLE, listed, table
from calibration.scene.result import SceneCalibration
from rig.atomic_write import write_atomically


def write_scene_report(calibration: SceneCalibration, path: Path) -> None:
    """Writes the calibration's report as one HTML page."""
    write_atomically(path, scene_page(calibration).encode())


def scene_page(calibration: SceneCalibration) -> str:
    """Returns the report of a calibration as the text of an HTML page."""
    figures, scale = calibration.figures(), calibration.scale
    mark = "bad" if scale.assumed else "good"
    total = len(calibration.rig) + len(calibration.left_out)
    summary = (
        f"{len(calibration.rig)} of {total} views joined over {figures['points']} points of the scene, "
        f"2D residual RMS <b>{figures['rms_px']:.3f} px</b>. Front camera: {escape(calibration.front)} (a guess unless "
        "it was named)."
    )
    scale_line = (
        f"Scale: <span class='{mark}'>{escape(scale.provenance.text)}</span>, good to {100 * scale.share:.2g} %."
    )
    refined = "" if calibration.refinement is None else f"<p>Silhouettes: {escape(calibration.refinement.text)}.</p>"
    head = ("camera", "points", "RMS px", "uncertainty at the subject px", "focal length px", "centre mm")
    rows = [
        (
            name,
            f"{row['points']} of {row['features']}",
            f"{row['rms_px']:.3f}",
            f"{row['pose_sigma_px']:.3f}",
            f"{row['focal_px']:.1f} &plusmn; {row['focal_sigma_px']:.1f}",
            ", ".join(f"{value:.1f}" for value in calibration.rig[name].centre_world),
        )
        for name, row in figures["cameras"].items()
    ]
    return "\n".join(
        [
            "<!doctype html><html lang='en'><meta charset='utf-8'><title>Calibration from the scene</title>",
            f"<style>{STYLE}</style><h1>Calibration from the scene</h1><p>{summary}</p><p>{scale_line}</p>{refined}",
            listed("Views that did not join", calibration.absences()),
            listed("Warnings", calibration.warnings),
            "<h2>Cameras</h2>",
            table(head, rows),
            "</html>",
        ]
    )
