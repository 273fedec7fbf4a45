"""Named frames: one way between any two, and its covariance."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import FrameConflict, InvalidParameter, UnknownFrame
from compute.pose.transform import Transform
from compute.pose.transform_graph import FrameLink, TransformGraph
from tests.compute.pose.motions import pose_covariance, transforms


def room(seconds: float = 1.0) -> TransformGraph:
    """Return a tracker that sees a pointer and a reference, and an image of the patient."""
    chance = np.random.default_rng(0)

    def some() -> Transform:
        return Transform.from_rotation_vector(
            chance.normal(size=3), 100.0 * chance.normal(size=3), pose_covariance(chance)
        )

    graph = TransformGraph()
    graph.connect("tracker", "pointer", some(), int(seconds * 1e9))
    graph.connect("tracker", "reference", some(), int(seconds * 1e9) - 5)
    graph.connect("reference", "image", some())
    return graph


def test_a_way_is_the_product_of_its_links() -> None:
    graph = room()
    by = {(one.to, one.from_): one.transform for one in graph.links}
    found = graph.transform("image", "pointer")
    assert found.path == ("pointer", "tracker", "reference", "image")
    wanted = (by["tracker", "reference"] @ by["reference", "image"]).inverse() @ by[
        "tracker", "pointer"
    ]
    assert np.allclose(found.transform.matrix, wanted.matrix)
    assert found.transform.covariance is not None
    assert wanted.covariance is not None
    assert np.allclose(found.transform.covariance, wanted.covariance, rtol=1e-6, atol=1e-12)
    assert (found.oldest_ns, found.newest_ns) == (10**9 - 5, 10**9)
    still = graph.transform("image", "reference")
    assert (still.oldest_ns, still.newest_ns) == (None, None)
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
    # What was refused changed nothing.
    assert len(graph.links) == 3


def test_what_is_not_known_is_named_with_what_is_there() -> None:
    graph = room()
    with pytest.raises(UnknownFrame, match='no frame "drill"; there are "tracker", "pointer"'):
        graph.transform("drill", "image")
    graph.connect("bed", "wall", Transform.identity())
    with pytest.raises(UnknownFrame) as caught:
        graph.transform("wall", "image")
    assert '"wall" with "bed"' in caught.value.detail
    assert '"image" is connected with "tracker", "pointer", "reference"' in caught.value.detail
    with pytest.raises(UnknownFrame, match='no transform connects "image" and "tracker" directly'):
        graph.update("tracker", "image", Transform.identity())
    with pytest.raises(UnknownFrame, match="there are none"):
        TransformGraph().transform("a", "b")


@pytest.mark.parametrize(("to", "from_"), [("", "a"), ("a", ""), ("a", "a")])
def test_names_that_mean_nothing(to: str, from_: str) -> None:
    with pytest.raises(InvalidParameter):
        TransformGraph().connect(to, from_, Transform.identity())


@given(transforms())
def test_a_newer_transform_takes_the_place_of_the_older_whichever_way_round(
    newer: Transform,
) -> None:
    graph = room()
    graph.update("tracker", "pointer", newer, 7)
    assert np.allclose(graph.transform("tracker", "pointer").transform.matrix, newer.matrix)
    graph.update("pointer", "tracker", newer, 8)
    found = graph.transform("pointer", "tracker")
    assert np.allclose(found.transform.matrix, newer.matrix, atol=1e-8)
    assert (found.oldest_ns, len(graph.links)) == (8, 3)


def test_what_is_taken_out_may_be_connected_another_way() -> None:
    graph = TransformGraph([FrameLink("a", "b", Transform.identity())])
    graph.connect("b", "c", Transform.identity())
    graph.disconnect("b", "a")
    assert graph.frames == ("b", "c")
    graph.connect("a", "c", Transform.identity())
    assert graph.transform("a", "b").path == ("b", "c", "a")
