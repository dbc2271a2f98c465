import numpy as np
import pytest
from analytic_stream import POSE_AXES

from nl_env.keyframes import VIEW_MEMORY_US, NewActorDetector, label_keyframe, visible
from nl_env.types import SLICE_US, Camera, EgoState

CAMERA = Camera.from_fov(48, 64, 70.0)
OPEN = np.zeros(CAMERA.shape, np.float32)


def camera_pose(x=0.0):
    pose = np.eye(4)
    pose[:3, :3] = POSE_AXES
    pose[0, 3] = x
    return pose


def state(speed=0.0, distance=100.0, new=0):
    return EgoState(np.eye(4), np.zeros(6), speed, distance, new)


@pytest.mark.parametrize(
    ("ego", "causes"),
    [
        (state(), (False, False, False)),
        (state(speed=10.0), (False, False, False)),
        (state(speed=10.01), (True, False, False)),
        (state(distance=8.0), (False, False, False)),
        (state(distance=7.99), (False, True, False)),
        (state(distance=np.inf), (False, False, False)),
        (state(new=2), (False, False, True)),
    ],
)
def test_each_cause_alone(ego, causes):
    label = label_keyframe(ego)
    assert (label.speed, label.distance, label.new) == causes
    assert label.label is any(causes)


@pytest.mark.parametrize(
    ("centre", "seen"),
    [
        ((20.0, 0.0, 0.0), True),
        ((20.0, 10.0, 0.0), True),
        ((20.0, 25.0, 0.0), False),  # left of a 35 degree half field of view
        ((-20.0, 0.0, 0.0), False),
        ((20.0, 0.0, 15.0), False),  # above the image
        ((61.0, 0.0, 0.0), False),
    ],
)
def test_visible_inside_the_field_of_view_and_range(centre, seen):
    assert visible(np.array([[*centre, 0.75]]), camera_pose(), OPEN, CAMERA)[0] == seen


def test_a_nearer_surface_hides_an_actor_but_its_own_does_not():
    actor = np.array([[20.0, 0.0, 0.0, 0.75]])
    assert not visible(actor, camera_pose(), np.full(CAMERA.shape, 10.0, np.float32), CAMERA)[0]
    assert visible(actor, camera_pose(), np.full(CAMERA.shape, 17.75, np.float32), CAMERA)[0]


def test_an_actor_is_new_once_and_again_after_the_memory_has_passed():
    detector = NewActorDetector(CAMERA)
    ahead, behind = np.array([[20.0, 0, 0, 1]]), np.array([[-20.0, 0, 0, 1]])
    t = 0

    def look(centres, steps=1):
        nonlocal t
        counts = []
        for _ in range(steps):
            counts.append(detector.update(centres, camera_pose(), OPEN, t))
            t += SLICE_US
        return counts

    assert look(behind, 3) == [0, 0, 0]
    assert look(ahead, 3) == [1, 0, 0]
    look(behind, VIEW_MEMORY_US // SLICE_US - 1)
    assert look(ahead) == [0]
    look(behind, VIEW_MEMORY_US // SLICE_US)
    assert look(ahead) == [1]


def test_actors_of_the_first_slice_are_not_new_and_reset_forgets():
    detector = NewActorDetector(CAMERA)
    ahead = np.array([[20.0, 0, 0, 1], [30.0, 2, 0, 1]])
    for _ in range(2):
        assert detector.update(ahead, camera_pose(), OPEN, 0) == 0
        assert detector.update(ahead, camera_pose(), OPEN, SLICE_US) == 0
        detector.reset()


def test_no_actors_at_all():
    assert NewActorDetector(CAMERA).update(np.empty((0, 4)), camera_pose(), OPEN, 0) == 0
