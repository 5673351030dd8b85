"""Depth maps and textured meshes as files that other programs open: glTF binary (GLB), PLY, NPY and 16-bit PNG."""
