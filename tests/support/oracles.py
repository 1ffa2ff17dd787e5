"""Slow, independent references. Nothing here shares code with what it checks: own projection, own rasteriser."""

import numpy as np


def project(points, rotation, translation, fx, fy, cx, cy, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0):
    """Pixels (N, 2) and depth (N,) by the Brown-Conrady formulas, written out again; pixel (0, 0) is a centre."""
    camera = points @ np.asarray(rotation).T + translation
    x, y = camera[:, 0] / camera[:, 2], camera[:, 1] / camera[:, 2]
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([fx * xd + cx, fy * yd + cy], axis=1), camera[:, 2]


def rasterise(pixels, depth, faces, width, height):
    """Depth (H, W), inf where nothing covers the pixel's centre: edge functions, one triangle after the other."""
    image = np.full((height, width), np.inf)
    for a, b, c in faces:
        corners = pixels[[a, b, c]]
        left, top = np.maximum(np.ceil(corners.min(axis=0)), 0).astype(int)
        right, bottom = np.minimum(np.floor(corners.max(axis=0)), (width - 1, height - 1)).astype(int)
        if right < left or bottom < top:
            continue
        x, y = np.meshgrid(np.arange(left, right + 1), np.arange(top, bottom + 1))
        (x0, y0), (x1, y1), (x2, y2) = corners
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0:
            continue
        w1 = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / area
        w2 = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / area
        inside = (w1 >= 0) & (w2 >= 0) & (w1 + w2 <= 1)
        z = 1 / ((1 - w1 - w2) / depth[a] + w1 / depth[b] + w2 / depth[c])  # 1/z is linear in the image
        part = image[top : bottom + 1, left : right + 1]
        part[inside] = np.minimum(part, z)[inside]
    return image


def camera_depth(camera, vertices, faces):
    """``rasterise`` for one of our cameras, through its numbers only."""
    k, d, pose = camera.intrinsics, camera.intrinsics.distortion, camera.camera_from_world
    pixels, depth = project(
        vertices, pose.rotation, pose.translation, k.fx, k.fy, k.cx, k.cy, d.k1, d.k2, d.p1, d.p2, d.k3
    )
    return rasterise(pixels, depth, faces, k.width, k.height)
