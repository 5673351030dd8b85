"""From sparse surface points to a dense textured surface of every image.

`spline` and `network` are the two ways to a dense depth map, `region` says where the surface is, `densify` is the job
over all images and `layout` the folder that it leaves. Only `network`, `encoders`, `checkpoint` and `train` need torch.
"""
