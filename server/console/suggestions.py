"""Handles suggested pixels of feature points: which are still open, which become points. Pure functions."""

from collections.abc import Iterator

from server.storage.face_cache import PixelsOfPoints


def open_suggestions(suggested: PixelsOfPoints, points: PixelsOfPoints) -> PixelsOfPoints:
    """Returns the suggestions (pixels, by point and camera) without those for views in which the point is set
    already."""
    left = {
        name: {camera: at for camera, at in views.items() if camera not in points.get(name, {})}
        for name, views in suggested.items()
    }
    return {name: views for name, views in left.items() if views}


def take_suggestions(
    points: PixelsOfPoints, suggested: PixelsOfPoints, point: str | None = None, camera: str | None = None
) -> PixelsOfPoints:
    """Returns the points with suggestions added: those of ``point`` in the view ``camera``, of ``point`` in all views
    if ``camera`` is None, or all if both are None. Points that are set already stay."""
    taken = {name: dict(views) for name, views in points.items()}
    for name, view, at in _of(open_suggestions(suggested, points), point, camera):
        taken.setdefault(name, {})[view] = at
    return taken


def drop_suggestions(suggested: PixelsOfPoints, point: str | None = None, camera: str | None = None) -> PixelsOfPoints:
    """Returns the suggestions without those of ``point`` in the view ``camera``, of ``point`` in all views if
    ``camera`` is None, or without any if both are None."""
    left = {name: dict(views) for name, views in suggested.items()}
    for name, view, _ in _of(suggested, point, camera):
        left[name].pop(view)
    return {name: views for name, views in left.items() if views}


def _of(suggested: PixelsOfPoints, point: str | None, camera: str | None) -> Iterator[tuple[str, str, list[float]]]:
    for name, views in suggested.items():
        for view, at in views.items():
            if point in (None, name) and camera in (None, view):
                yield name, view, at
