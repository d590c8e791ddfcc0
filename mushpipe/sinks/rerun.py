"""Sink `rerun`: every step of the pipeline in the Rerun viewer or an .rrd file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, PrivateAttr

from mushpipe import Circles, DepthSource, GraphPath, Mask, Picks, RgbdFrame, RunInfo, Sink

_IMAGE = "camera/image"
_DETECTED = (0, 200, 255)


class RerunSink(Sink):
    """Shows colour, depth, mask, circles and labels; saved to a file, or in a viewer."""

    delivery: ClassVar[Literal["every", "latest"]] = "latest"

    save: GraphPath | None = Field(
        None, description=".rrd file to write; {recording} is the name of the input"
    )
    spawn: bool = Field(False, description="open a viewer")
    jpeg_quality: int = Field(85, ge=1, le=100, description="quality of the stored colour images")

    _recording: Any = PrivateAttr(None)

    def files(self, run: RunInfo) -> tuple[Path, ...]:
        """Return the file it writes."""
        return (run.path(self.save),) if self.save else ()

    def open(self, run: RunInfo) -> None:
        """Create the recording and send the layout."""
        import rerun as rr

        if not (self.save or self.spawn):
            raise ValueError("nothing to do: set 'save' to a file, or 'spawn' to true")
        self._recording = rr.RecordingStream("mushpipe", recording_id=run.recording)
        if self.spawn:
            self._recording.spawn()
        if self.save:
            self._recording.save(str(run.path(self.save)))
        self._recording.send_blueprint(_blueprint())
        classes = [(0, "bed", (0, 0, 0, 0)), (1, "mushroom", (60, 220, 90, 255))]
        for layer in ("mask", "initial"):
            context = rr.AnnotationContext(classes)
            self._recording.log(f"{_IMAGE}/{layer}", context, static=True)

    def consume(
        self,
        frame: RgbdFrame,
        mask: Mask | None = None,
        circles: Circles | None = None,
        picks: Picks | None = None,
    ) -> None:
        """Log one frame."""
        import rerun as rr

        rec = self._recording
        rec.set_time("frame", sequence=frame.header.sequence)
        rec.set_time("capture", timestamp=np.datetime64(frame.header.stamp_ns, "ns"))
        self._log_frame(frame)
        if mask is not None:
            rec.log(f"{_IMAGE}/mask", rr.SegmentationImage(mask.foreground.astype(np.uint8)))
            if mask.initial is not None:
                initial = rr.SegmentationImage(mask.initial.astype(np.uint8))
                rec.log(f"{_IMAGE}/initial", initial)
        outlines = circles if picks is None else picks
        if outlines is not None:
            ellipses = rr.Ellipses2D(
                centers=outlines.center,
                half_sizes=np.repeat(outlines.radius[:, None], 2, axis=1),
                colors=[_DETECTED] if picks is None else _colors(picks),
                labels=None if picks is None else _labels(picks),
            )
            rec.log(f"{_IMAGE}/circles", ellipses)
        if picks is not None:
            known = picks.source != DepthSource.MISSING
            radii = np.nan_to_num(picks.diameter[known]) / 2
            place = "camera" if picks.frame_id == frame.header.frame_id else picks.frame_id
            rec.log(f"{place}/picks", rr.Points3D(picks.position[known], radii=radii))

    def _log_frame(self, frame: RgbdFrame) -> None:
        import rerun as rr

        rec, camera = self._recording, frame.camera
        color = rr.Image(frame.color).compress(jpeg_quality=self.jpeg_quality)
        rec.log(f"{_IMAGE}/color", color)
        if camera is not None:
            pinhole = rr.Pinhole(
                focal_length=(camera.fx, camera.fy),
                principal_point=(camera.cx, camera.cy),
                width=camera.width,
                height=camera.height,
            )
            rec.log(_IMAGE, pinhole)
        if frame.depth is not None:
            known = frame.depth[frame.depth > 0]
            reach = np.percentile(known, (1, 99)) if known.size else None
            depth = rr.DepthImage(frame.depth, meter=1 / frame.depth_scale, depth_range=reach)
            rec.log(f"{_IMAGE}/depth", depth)

    def close(self) -> None:
        """Finish the file."""
        if self._recording is not None:
            self._recording.flush()
            self._recording.disconnect()
            self._recording = None


def _labels(picks: Picks) -> list[str]:
    """Return per pick its id, and its diameter where it is known."""
    sizes = (f" {1000 * d:.0f} mm" if np.isfinite(d) else " size unknown" for d in picks.diameter)
    return [f"{i}{size}" for i, size in zip(picks.id, sizes, strict=True)]


def _colors(picks: Picks) -> list[tuple[int, int, int]]:
    """Green is measured, amber estimated from neighbours, red without depth."""
    palette = {0: (255, 70, 70), 1: (60, 220, 90), 2: (255, 190, 40)}
    return [palette[int(source)] for source in picks.source]


def _blueprint() -> Any:
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial2DView(
                origin=_IMAGE,
                name="Picks",
                contents=[f"{_IMAGE}/color", f"{_IMAGE}/circles"],
            ),
            rrb.Vertical(
                rrb.Spatial2DView(
                    origin=_IMAGE, name="Mask", contents=[f"{_IMAGE}/color", f"{_IMAGE}/mask"]
                ),
                rrb.Spatial2DView(origin=_IMAGE, name="Depth", contents=[f"{_IMAGE}/depth"]),
            ),
            column_shares=[2, 1],
        ),
        collapse_panels=True,
    )
