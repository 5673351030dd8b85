"""From sparse surface points to a dense textured surface of every image.

`spline_depth` and `network_depth` are the two ways to a dense depth map, `choose` picks one, `region` says where the
surface is, `densify` is the job over all images and `layout` the folder that it leaves. Only `encoders`, `network`,
`checkpoint`, `network_depth` and `train` import torch.
"""
