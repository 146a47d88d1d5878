"""The frames of ROS bags: where each is in its parent over time, and by these where cameras are in the world."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.errors import InputError, SettingError
from valuemap.readers.poses import given_and_motions, interpolate_poses, rotations_of_quaternions

_UNUSABLE = "a number is not finite, or the quaternion is not of length 1"


@dataclass
class _Edge:
    """Where a frame is in one parent: at times (ns), or for ever where nothing says otherwise."""

    is_static: bool = True
    time_ns: list[int] = field(default_factory=list)
    pose: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, time_ns: int, pose: tuple[float, ...], *, is_static: bool) -> None:
        self.is_static &= is_static
        self.time_ns.append(time_ns)
        self.pose.append(pose)

    def usable(self) -> tuple[Ints, Floats, Floats]:
        """Return times (M), rotations (M, 3, 3) and translations (M, 3) of the poses that can be used."""
        values = np.array(self.pose)
        rotation, place = rotations_of_quaternions(values[:, [6, 3, 4, 5]]), values[:, :3]
        _, fine = given_and_motions(rotation, place)
        return np.array(self.time_ns, dtype=np.int64)[fine], rotation[fine], place[fine]


@dataclass
class Frames:
    """What a bag says about its frames.

    Parameters
    ----------
    source
        What errors name as the place of the data.
    pose_topic
        The topic that `add_pose` is told of; None where there is none.
    other_topics
        Those that could be named as such instead.
    """

    source: str
    pose_topic: str | None = None
    other_topics: tuple[str, ...] = ()
    _transforms: dict[str, dict[str, _Edge]] = field(default_factory=lambda: defaultdict(dict))
    _poses: dict[str, dict[str, _Edge]] = field(default_factory=lambda: defaultdict(dict))
    _used: dict[tuple[str, str], tuple[Ints, Floats, Floats]] = field(default_factory=dict)

    def add_transform(self, parent: str, child: str, time_ns: int, pose: tuple[float, ...], *, is_static: bool) -> None:
        """Take a transform of tf: translation and quaternion x y z w (7) from the child into the parent."""
        self._transforms[child].setdefault(parent, _Edge()).add(time_ns, pose, is_static=is_static)

    def add_pose(self, parent: str, child: str, time_ns: int, pose: tuple[float, ...]) -> None:
        """Take a pose of the topic of poses, which replace all transforms of that child."""
        self._poses[child].setdefault(parent, _Edge()).add(time_ns, pose, is_static=False)

    def path(self, frame: str, world: str | None) -> list[str]:
        """Return the frames from a camera's up to the world, or to the top of the tree.

        Raises
        ------
        InputError
            There is no transform of the camera's frame, they go in a circle, or a frame has several parents.
        SettingError
            The camera is not below the world.
        """
        if not self._parents(frame):
            raise InputError(
                f"{self.source}: there is no transform of the camera's frame {frame!r}",
                hint=f"record /tf and /tf_static{self.or_topic()}",
            )
        above = self._ancestors(frame)
        if world is not None and world not in above:
            raise SettingError(
                f"world-frame {world}: the camera {frame} is not below it",
                hint=f"it is below {', '.join(sorted(above - {frame}))}",
            )
        way = [frame]
        while way[-1] != world and (parents := self._parents(way[-1])):
            leading = [parent for parent in parents if world is None or world in self._ancestors(parent)]
            if len(leading) > 1:
                raise self._several_parents(way[-1], sorted(leading))
            if leading[0] in way:
                raise InputError(
                    f"{self.source}: the transforms above {frame} go in a circle", hint="repair the tree of frames"
                )
            way.append(leading[0])
        return way

    def poses_along(self, path: list[str], time_ns: Ints, longest_ns: int) -> tuple[Floats, Floats]:
        """Return rotations (N, 3, 3) from the first frame of a path into the last, and the first one's origins (N, 3).

        They are NaN at times that are not between two poses at most `longest_ns` apart.

        Raises
        ------
        InputError
            Poses of a frame in its parent are all unusable, or all at time 0.
        """
        rotation = np.broadcast_to(np.eye(3), (len(time_ns), 3, 3))
        center = np.zeros((len(time_ns), 3))
        for child, parent in pairwise(path):
            turned, moved = self._pose_at(child, parent, time_ns, longest_ns)
            rotation, center = turned @ rotation, np.einsum("nij,nj->ni", turned, center) + moved
        return rotation, center

    def check_topic_counts(self, paths: list[list[str]]) -> None:
        """Raise `SettingError` where the topic of poses says nothing about any of the cameras with these paths."""
        if self.pose_topic is None or any(frame in self._poses for path in paths for frame in path[:-1]):
            return
        frames = sorted({frame for path in paths for frame in path})
        raise SettingError(
            f"pose-topic {self.pose_topic}: its poses are of {_listed(sorted(self._poses)) or 'nothing'}, "
            "and no camera is below that",
            hint=f"say with --body-frame what they are of, one of {', '.join(frames)}",
        )

    def or_topic(self) -> str:
        """Return the end of a hint: which topics of poses could be named instead."""
        if not self.other_topics:
            return f" (there is no {'' if self.pose_topic is None else 'other '}topic of poses)"
        return f", or give --pose-topic, one of {', '.join(self.other_topics)}"

    def notes(self) -> Iterator[str]:
        """Yield how many poses that were needed could not be used."""
        for child, parent in sorted(self._used):
            count = len(self._parents(child)[parent].pose)
            left_out = count - len(self._used[child, parent][0])
            if left_out:
                yield f"left out: {left_out} of {count} poses of {child!r} in {parent!r}: {_UNUSABLE}"

    def _parents(self, child: str) -> dict[str, _Edge]:
        return self._poses.get(child) or self._transforms.get(child, {})

    def _ancestors(self, frame: str) -> set[str]:
        """Return a frame and all that are above it."""
        found, waiting = {frame}, [frame]
        while waiting:
            new = self._parents(waiting.pop()).keys() - found
            found |= new
            waiting += new
        return found

    def _several_parents(self, child: str, parents: list[str]) -> InputError:
        """Return what to say where several parents lead to the world; those choose that no other is below."""
        of = self.pose_topic if child in self._poses else "tf"
        choosing = [
            parent
            for parent in parents
            if not any(parent in self._ancestors(other) for other in parents if other != parent)
        ]
        choice = f"choose with --world-frame {' or '.join(choosing)}" if choosing else "record one of them only"
        return InputError(
            f"{self.source}: the frame {child!r} has several parents in {of}: {_listed(parents)}",
            hint=f"{choice}{self.or_topic()}",
        )

    def _pose_at(self, child: str, parent: str, time_ns: Ints, longest_ns: int) -> tuple[Floats, Floats]:
        edge = self._parents(child)[parent]
        if (child, parent) not in self._used:  # Cameras of one car have most of their path in common.
            self._used[child, parent] = edge.usable()
        known, rotation, place = self._used[child, parent]
        if not len(known):
            raise InputError(
                f"{self.source}: none of {len(edge.pose)} poses of {child!r} in {parent!r} can be used: {_UNUSABLE}",
                hint=f"repair what publishes them{self.or_topic()}",
            )
        if edge.is_static:
            return (
                np.broadcast_to(rotation[-1], (len(time_ns), 3, 3)).copy(),
                np.broadcast_to(place[-1], (len(time_ns), 3)).copy(),
            )
        if len(known) > 1 and not known.any():
            raise InputError(
                f"{self.source}: all {len(known)} poses of {child!r} in {parent!r} have the stamp 0 in their headers",
                hint="the stamps say when it was there: set them where the poses are published",
            )
        known, first = np.unique(known, return_index=True)
        turned, moved, _ = interpolate_poses(time_ns, known, rotation[first], place[first], longest_ns)
        return turned, moved


def _listed(names: list[str]) -> str:
    return ", ".join(repr(name) for name in names)
