"""Computes with several calibrated views at once: triangulation (the paper's section 4.2), visual hull, epipolar
tangencies, and the upward direction.

The package's input is image points or silhouettes, and the rig. The output is points, volumes and distances in mm in
the world frame."""
