"""Named frames: one way between any two, and its covariance."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import FrameConflict, InvalidParameter, UnknownFrame
from compute.pose.transform_graph import TransformGraph
from compute.transform import Transform
from tests.compute.pose.motions import pose_covariance, transforms


def some(seed: int) -> Transform:
    chance = np.random.default_rng(seed)
    return Transform.from_rotation_vector(
        chance.normal(size=3), 100.0 * chance.normal(size=3), pose_covariance(chance)
    )


TRACKER_POINTER, TRACKER_REFERENCE, REFERENCE_IMAGE = some(0), some(1), some(2)


def room() -> TransformGraph:
    """Return a tracker that sees a pointer and a reference, and an image of the patient."""
    graph = TransformGraph()
    graph.connect("tracker", "pointer", TRACKER_POINTER)
    graph.connect("tracker", "reference", TRACKER_REFERENCE)
    graph.connect("reference", "image", REFERENCE_IMAGE)
    return graph


def test_a_path_is_the_product_of_its_transforms() -> None:
    graph = room()
    found = graph.transform("image", "pointer")
    assert found.path == ("pointer", "tracker", "reference", "image")
    wanted = (TRACKER_REFERENCE @ REFERENCE_IMAGE).inverse() @ TRACKER_POINTER
    assert np.allclose(found.transform.matrix, wanted.matrix)
    assert found.transform.covariance is not None
    assert wanted.covariance is not None
    assert np.allclose(found.transform.covariance, wanted.covariance, rtol=1e-6, atol=1e-12)
    assert graph.transform("image", "image").path == ("image",)


@settings(max_examples=40)
@given(st.data(), st.integers(2, 8))
def test_in_any_tree_there_and_back_is_nothing(data: st.DataObject, count: int) -> None:
    graph = TransformGraph()
    places = [Transform.identity()]
    for one in range(1, count):
        other = data.draw(st.integers(0, one - 1))
        link = data.draw(transforms())
        if data.draw(st.booleans()):
            graph.connect(str(other), str(one), link)
        else:
            graph.connect(str(one), str(other), link.inverse())
        places.append(places[other] @ link)
    first, second = data.draw(st.integers(0, count - 1)), data.draw(st.integers(0, count - 1))
    found = graph.transform(str(first), str(second)).transform
    wanted = places[first].inverse() @ places[second]
    assert np.allclose(found.matrix, wanted.matrix, atol=1e-6)
    back = graph.transform(str(second), str(first)).transform
    assert np.allclose((found @ back).matrix, np.eye(4), atol=1e-6)


def test_a_second_way_is_refused_with_the_first() -> None:
    graph = room()
    with pytest.raises(FrameConflict) as caught:
        graph.connect("image", "pointer", Transform.identity())
    assert caught.value.context["path"] == ["pointer", "tracker", "reference", "image"]
    assert '"pointer" - "tracker" - "reference" - "image"' in caught.value.detail
    with pytest.raises(FrameConflict):
        graph.connect("reference", "tracker", Transform.identity())
    # The refused transforms changed nothing.
    assert graph.transform("image", "reference").path == ("reference", "image")


def test_what_is_not_known_is_named_with_what_is_there() -> None:
    graph = room()
    with pytest.raises(UnknownFrame, match='no frame "drill"; there are "tracker", "pointer"'):
        graph.transform("drill", "image")
    graph.connect("bed", "wall", Transform.identity())
    with pytest.raises(UnknownFrame) as caught:
        graph.transform("wall", "image")
    assert '"wall" with "bed"' in caught.value.detail
    assert '"image" is connected with "tracker", "pointer", "reference"' in caught.value.detail
    with pytest.raises(UnknownFrame, match="there are none"):
        TransformGraph().transform("a", "b")


@pytest.mark.parametrize(("to", "from_"), [("", "a"), ("a", ""), ("a", "a")])
def test_names_that_mean_nothing(to: str, from_: str) -> None:
    with pytest.raises(InvalidParameter):
        TransformGraph().connect(to, from_, Transform.identity())
