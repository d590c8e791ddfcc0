"""The built-in plugins; they are registered like everybody else's and imported when used."""

from mushpipe.core.plugins import Registry, hookimpl


@hookimpl
def mushpipe_register(registry: Registry) -> None:
    """Register the built-in sources, stages and sinks."""
    registry.source("mcap", "mushpipe.sources.mcap:McapSource")
    registry.source("images", "mushpipe.sources.folder:ImagesSource")
    registry.source("stream", "mushpipe.sources.stream:StreamSource")
    registry.source("realsense", "mushpipe.sources.realsense:RealsenseSource")
    registry.source("synthetic", "mushpipe.sources.synthetic:SyntheticSource")
    registry.stage("otsu", "mushpipe.stages.otsu:Otsu")
    registry.stage("chan-vese", "mushpipe.stages.chan_vese:ChanVese")
    registry.stage("kmeans", "mushpipe.stages.kmeans:KMeans")
    registry.stage("height", "mushpipe.stages.height:Height")
    registry.stage("flatten", "mushpipe.stages.flatten:Flatten")
    registry.stage("opening", "mushpipe.stages.opening:Opening")
    registry.stage("phase-hough", "mushpipe.stages.phase_hough:PhaseHough")
    registry.stage("cap-net", "mushpipe.stages.cap_net:CapNet")
    registry.stage("onnx", "mushpipe.stages.onnx_model:Onnx")
    registry.stage("hough", "mushpipe.stages.hough:Hough")
    registry.stage("hough-skimage", "mushpipe.stages.hough:HoughSkimage")
    registry.stage("nearest-depth", "mushpipe.stages.nearest_depth:NearestDepth")
    registry.stage("depth-correct", "mushpipe.stages.depth_correct:DepthCorrect")
    registry.stage("fuse-depth", "mushpipe.stages.fuse_depth:FuseDepth")
    registry.stage("surface-fit", "mushpipe.stages.surface_fit:SurfaceFit")
    registry.stage("cap-fit", "mushpipe.stages.cap_fit:CapFit")
    registry.stage("registration", "mushpipe.stages.registration:Registration")
    registry.stage("picks", "mushpipe.stages.picks:MakePicks")
    registry.sink("mcap", "mushpipe.sinks.mcap:McapSink")
    registry.sink("rerun", "mushpipe.sinks.rerun:RerunSink")
    registry.sink("foxglove", "mushpipe.sinks.foxglove:FoxgloveSink")
    registry.sink("robot-json", "mushpipe.sinks.robot_json:RobotJsonSink")
