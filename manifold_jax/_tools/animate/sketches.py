"""The mechanisms of the gallery that can be drawn."""

from . import planar, spatial
from .motion import Sketch


SKETCHES: dict[str, Sketch] = {
    "pendulum": planar.sketch_chain,
    "double-pendulum": planar.sketch_chain,
    "chain": planar.sketch_chain,
    "slider-crank": planar.sketch_slider_crank,
    "four-bar": planar.sketch_four_bar,
    "n-four-bar": planar.sketch_n_four_bar,
    "parallelogram": planar.sketch_parallelogram,
    "falling-truss": planar.sketch_falling_truss,
    "newtons-cradle": planar.sketch_newtons_cradle,
    "compass-gait": planar.sketch_compass_gait,
    "spherical-pendulum": spatial.sketch_rod,
    "rotating-hoop": spatial.sketch_rotating_hoop,
    "polymer": spatial.sketch_beads,
    "cable-net": spatial.sketch_cable_net,
    "delta-robot": spatial.sketch_delta_robot,
    "stewart-platform": spatial.sketch_stewart_platform,
}
