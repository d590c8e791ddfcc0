"""The built-in plugins; they are registered like everybody else's and imported when used."""

from mushpipe.core.plugins import Registry, hookimpl


@hookimpl
def mushpipe_register(registry: Registry) -> None:
    """Register the built-in sources, stages and sinks."""
    registry.source("mcap", "mushpipe.sources.mcap:McapSource")
    registry.source("realsense", "mushpipe.sources.realsense:RealsenseSource")
    registry.source("synthetic", "mushpipe.sources.synthetic:SyntheticSource")
    registry.stage("otsu", "mushpipe.stages.otsu:Otsu")
    registry.stage("chan-vese", "mushpipe.stages.chan_vese:ChanVese")
    registry.stage("opening", "mushpipe.stages.opening:Opening")
    registry.stage("hough", "mushpipe.stages.hough:Hough")
    registry.stage("nearest-depth", "mushpipe.stages.nearest_depth:NearestDepth")
    registry.stage("picks", "mushpipe.stages.picks:MakePicks")
    registry.sink("mcap", "mushpipe.sinks.mcap:McapSink")
    registry.sink("rerun", "mushpipe.sinks.rerun:RerunSink")
