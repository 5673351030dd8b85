"""Deformable SLAM: a reconstruction and camera poses in one graph and one world frame."""

from connrsfm_graph.slam.assemble import MapModel, add_reconstruction, pose_key
from connrsfm_graph.slam.fuse import Fused, FusionConfig, fuse
from connrsfm_graph.slam.incremental import IncrementalConfig, IncrementalFusion
from connrsfm_graph.slam.keyframes import KeyframeConfig, Keyframes
from connrsfm_graph.slam.live import LiveFusion, fuse_live
from connrsfm_graph.slam.noise import FusionNoise, estimate_noise
from connrsfm_graph.slam.run import SlamConfig, pose_problem, solve_problem
from connrsfm_graph.slam.sightings import Sightings, View
from connrsfm_graph.slam.storage import FusionProblem, load_problem, save_problem, write_map
from connrsfm_graph.slam.trajectory import TrajectoryError, read_tum, trajectory_error, write_tum

__all__ = [
    "Fused",
    "FusionConfig",
    "FusionNoise",
    "FusionProblem",
    "IncrementalConfig",
    "IncrementalFusion",
    "KeyframeConfig",
    "Keyframes",
    "LiveFusion",
    "MapModel",
    "Sightings",
    "SlamConfig",
    "TrajectoryError",
    "View",
    "add_reconstruction",
    "estimate_noise",
    "fuse",
    "fuse_live",
    "load_problem",
    "pose_key",
    "pose_problem",
    "read_tum",
    "save_problem",
    "solve_problem",
    "trajectory_error",
    "write_map",
    "write_tum",
]
