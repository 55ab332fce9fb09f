"""The windows that are made from what was drawn."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb

from physx_core.components import Factory
from physx_rerun.drawing.chunks import ChunkBuilder
from physx_rerun.drawing.drawing import Drawing
from physx_rerun.drawing.windows import WindowLayout


def views(container):
    for content in container.contents:
        if isinstance(content, rrb.View):
            yield content
        else:
            yield from views(content)


def drawn(instance_nb, **view):
    layout = WindowLayout(instance_nb)
    for instance_id in range(1, instance_nb + 1):
        factory = Factory()
        if view and instance_id == 1:
            factory.set_view(**view)
        factory.add_sphere("ball", 0.1)
        factory.add_scalars("error", ["position"])
        drawing = Drawing(instance_id, ChunkBuilder(), layout, draws_shapes=True)
        drawing.draw(factory.take_events(), {"step": 0})
    return layout.blueprint().root_container


def test_each_instance_has_a_window_of_its_name():
    names = [view.name for view in views(drawn(2, title="alone"))]
    assert names == ["alone", "environment 2", "error"]


def test_instances_are_seen_from_the_same_distance():
    layout = WindowLayout(3)
    for instance_id, radius in ((1, 0.1), (2, 0.4), (3, 0.2)):
        factory = Factory()
        factory.add_sphere("ball", radius)
        drawing = Drawing(instance_id, ChunkBuilder(), layout, draws_shapes=True)
        drawing.draw(factory.take_events(), {"step": 0})
    layout.blueprint()
    distances = [np.linalg.norm(layout.frame(each)._position) for each in (1, 2, 3)]
    assert np.allclose(distances, distances[0])


def test_the_camera_is_placed_where_the_environment_wants_it():
    (scene, _) = views(drawn(1, title="t", eye=[1, 2, 3], target=[0, 0, 1]))
    eye = scene.properties["EyeControls3D"]
    assert np.allclose(eye.position.as_arrow_array().to_pylist(), [[1, 2, 3]])
    assert np.allclose(eye.look_target.as_arrow_array().to_pylist(), [[0, 0, 1]])


def test_a_few_scenes_stand_in_a_row_above_the_plots():
    assert isinstance(drawn(1), rrb.Horizontal)
    assert isinstance(drawn(3), rrb.Vertical)
    assert isinstance(drawn(4), rrb.Horizontal)
