# SPDX-License-Identifier: Apache-2.0
"""Other programs' files: point clouds, poses and elevation models in; layers, meshes, sites out."""
