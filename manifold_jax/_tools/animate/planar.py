"""Sketches of the planar mechanisms of the gallery."""

import numpy as np

from .motion import DrawnMotion, line_through, Lines


def sketch_chain(motion: DrawnMotion) -> Lines:
    joints = motion.q.reshape(len(motion.q), -1, 2)
    return [np.concatenate([np.zeros((len(motion.q), 1, 2)), joints], axis=1)]


def sketch_newtons_cradle(motion: DrawnMotion) -> Lines:
    spacing = float(motion.args.spacing)
    balls = enumerate(np.moveaxis(motion.q, 1, 0))
    return [line_through((i * spacing, 0.0), tuple(ball.T)) for i, ball in balls]


def sketch_slider_crank(motion: DrawnMotion) -> Lines:
    """Draw the rod from the slider, with length 1."""
    crank, slider, rod = motion.q.T
    a = float(motion.args.crank_length)
    return [
        line_through((0 * crank, 0 * crank), (a * np.cos(crank), a * np.sin(crank))),
        line_through((slider - np.cos(rod), -np.sin(rod)), (slider, 0 * slider)),
    ]


def sketch_four_bar(motion: DrawnMotion) -> Lines:
    bodies = motion.q.reshape(len(motion.q), 3, 3)
    return _links(bodies, np.asarray(motion.args.lengths)[:3])


def sketch_n_four_bar(motion: DrawnMotion) -> Lines:
    return _links(motion.q, np.full(motion.q.shape[1], float(motion.args.length)))


def _links(bodies: np.ndarray, lengths: np.ndarray) -> Lines:
    """Draw links with the coordinates `(x, y, angle)` of their centres."""
    x, y, angle = np.moveaxis(bodies, 2, 0)
    dx, dy = lengths / 2 * np.cos(angle), lengths / 2 * np.sin(angle)
    ends = np.stack(
        [np.stack([x - dx, y - dy], axis=-1), np.stack([x + dx, y + dy], axis=-1)], axis=2
    )
    return list(np.moveaxis(ends, 1, 0))


def sketch_parallelogram(motion: DrawnMotion) -> Lines:
    x, y, tilt, *cranks = motion.q.T
    spacing, length = float(motion.args.spacing), float(motion.args.length)
    pivots = (-spacing, 0.0, spacing)
    coupler = [(x + s * np.cos(tilt), y + s * np.sin(tilt)) for s in pivots]
    hanging = [
        line_through((s + 0 * a, 0 * a), (s + length * np.sin(a), -length * np.cos(a)))
        for s, a in zip(pivots, cranks, strict=True)
    ]
    return [line_through(*coupler), *hanging]


def sketch_falling_truss(motion: DrawnMotion) -> Lines:
    """Draw the chords, and the posts and diagonals as one line."""
    lower, upper = motion.q[:, :, 0], motion.q[:, :, 1]
    zigzag = np.stack([lower, upper], axis=2).reshape(len(motion.q), -1, 2)
    return [lower, upper, zigzag]


def sketch_compass_gait(motion: DrawnMotion) -> Lines:
    """Draw both legs and the slope. The hip does not jump when the origin moves to the other foot."""
    hip, angles = motion.q[:, :2], motion.q[:, 2:]
    if motion.resets is not None:
        count = int(motion.resets.number)
        before, after = (x[0][:count, :2] for x in (motion.resets.before, motion.resets.after))
        happened = motion.times[:, None] >= np.asarray(motion.resets.times[:count])[None]
        hip = hip + happened.astype(float) @ np.asarray(before - after)
    length = float(motion.args.leg_length)
    feet = hip[:, None] + length * np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    start, end = hip[0, 0] - length, hip[-1, 0] + length
    slope = np.broadcast_to([[start, 0.0], [end, 0.0]], (len(hip), 2, 2))
    return [slope, *(np.stack([hip, feet[:, leg]], axis=1) for leg in (0, 1))]
