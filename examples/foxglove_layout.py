"""Writes graphs/foxglove-layout.json with the layout classes of Foxglove's own SDK."""

from pathlib import Path

import foxglove.layouts as fl

STAGES = ("correct", "flatten", "segment", "open", "detect", "pose", "pick")


def layout() -> fl.Layout:
    """Return image with circles, caps in space, the picks as a table, and the time per stage."""
    image = fl.ImageModeConfig(
        image_topic="/camera/color/image_raw",
        calibration_topic="/camera/color/camera_info",
        annotations={
            "/mushpipe/pick/annotations": fl.ImageAnnotationSettings(visible=True),
            "/mushpipe/detect/annotations": fl.ImageAnnotationSettings(visible=False),
        },
    )
    # The optical frame has z down into the bed: the look from the camera's side is from below.
    look = fl.ThreeDeeCameraState(
        distance=0.6, phi=150, theta_offset=0, target=(0, 0, 0.5), perspective=True
    )
    scene = fl.ThreeDeeConfig(
        camera_state=look,
        topics={
            "/mushpipe/pick/scene": fl.BaseRendererSceneUpdateTopicSettings(visible=True),
            "/camera/color/camera_info": fl.BaseRendererCameraTopicSettings(
                visible=True, distance=0.1
            ),
        },
    )
    times = [
        fl.PlotSeries(value=f"/mushpipe/timing.stages_ns.{stage}", label=stage, enabled=True)
        for stage in STAGES
    ]
    picks = fl.RawMessagesConfig(topic_path="/mushpipe/pick")
    left = fl.SplitContainer(
        direction="column",
        items=[
            fl.SplitItem(
                proportion=3, content=fl.ImagePanel(config=fl.ImageConfig(image_mode=image))
            ),
            fl.SplitItem(content=fl.PlotPanel(config=fl.PlotConfig(paths=times))),
        ],
    )
    right = fl.SplitContainer(
        direction="column",
        items=[
            fl.SplitItem(proportion=2, content=fl.ThreeDeePanel(config=scene)),
            fl.SplitItem(content=fl.RawMessagesPanel(config=picks)),
        ],
    )
    items = [fl.SplitItem(proportion=3, content=left), fl.SplitItem(proportion=2, content=right)]
    return fl.Layout(content=fl.SplitContainer(direction="row", items=items))


if __name__ == "__main__":
    Path("graphs/foxglove-layout.json").write_text(layout().to_json() + "\n")
