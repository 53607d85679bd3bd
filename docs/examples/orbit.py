#!/usr/bin/env python3
"""Films an orbit around a dataset: opens an Interact stream, sends poses, writes the frames as they come.

  pip install grpcio grpcio-tools
  docs/examples/orbit.py teapot --frames 12 --out frames [--size 640x480] [--format jpeg] [--server 127.0.0.1:7443]
"""
import argparse, math, pathlib, queue, sys, tempfile
import grpc, grpc_tools
from grpc_tools import protoc

# The stubs are generated from proto/ into a temporary folder; a program of your own would keep them.
proto, stubs = pathlib.Path(__file__).resolve().parents[2] / "proto", tempfile.TemporaryDirectory()
folders = [f"-I{proto}", f"-I{pathlib.Path(grpc_tools.__file__).parent / '_proto'}", f"--python_out={stubs.name}", f"--grpc_python_out={stubs.name}"]
if protoc.main(["protoc", *folders, *map(str, proto.glob("lumisphere/*/*.proto"))]) != 0:
    sys.exit("the stubs could not be generated")
sys.path.insert(0, stubs.name)
from lumisphere.v1alpha1 import datasets_pb2, datasets_pb2_grpc, rendering_pb2 as wire, rendering_pb2_grpc

flags = argparse.ArgumentParser()
flags.add_argument("dataset")
flags.add_argument("--frames", type=int, default=12)
flags.add_argument("--size", default="640x480")
flags.add_argument("--format", choices=["png", "jpeg"], default="png")
flags.add_argument("--out", type=pathlib.Path, required=True)
flags.add_argument("--server", default="127.0.0.1:7443")
args = flags.parse_args()
width, height = map(int, args.size.split("x"))
args.out.mkdir(parents=True, exist_ok=True)
channel = grpc.insecure_channel(args.server, options=[("grpc.max_receive_message_length", -1)])
dataset = datasets_pb2_grpc.DatasetsStub(channel).GetDataset(datasets_pb2.GetDatasetRequest(name=args.dataset), timeout=30)
box = next(v.object_bounds for v in dataset.versions if v.version == dataset.latest_version)
low, high = [(corner.x, corner.y, corner.z) for corner in (box.min, box.max)]
centre, distance = [(a + b) / 2 for a, b in zip(low, high)], 3.5 * math.dist(low, high) / 2

def camera(azimuth, elevation=math.radians(25)):
    (sin_a, cos_a), (sin_e, cos_e) = [(math.sin(angle), math.cos(angle)) for angle in (azimuth, elevation)]
    right, up, backward = (cos_a, 0, -sin_a), (-sin_e * sin_a, cos_e, -sin_e * cos_a), (cos_e * sin_a, sin_e, cos_e * cos_a)
    position = [c + distance * b for c, b in zip(centre, backward)]  # and looks along -backward, at the centre
    axes = dict(zip(["position", "right", "up", "backward"], [dict(zip("xyz", v)) for v in (position, right, up, backward)]))
    return dict(pose=axes, intrinsics=dict(width_px=width, height_px=height, focal_x_px=height / 2 / math.tan(math.radians(20))))

is_map = dataset.kind == "parameter_map"
settings = dict(parameter_map={}) if is_map else dict(offset_surface_light_field=dict(component="RECONSTRUCTION"))
output, shown, upward = dict(encoding=f"ENCODING_{args.format.upper()}"), 0, queue.SimpleQueue()
send = lambda **message: upward.put(wire.InteractRequest(**message))
look = lambda: send(pose=dict(pose_id=shown + 1, camera=camera(2 * math.pi * shown / args.frames)))
send(open=dict(dataset=args.dataset, version=dataset.latest_version, settings=settings, output=output))
look()
# One pose at a time: a newer one would overtake it. None ends the stream upward.
for answer in rendering_pb2_grpc.RenderingStub(channel).Interact(iter(upward.get, None)):
    if answer.HasField("status"):
        sys.exit(f"{answer.status.reason}: {answer.status.message}")
    if answer.HasField("frame"):
        send(acknowledge=dict(frame_id=answer.frame.frame_id))
        if answer.frame.is_final:  # coarse ones may come before
            (args.out / f"frame-{shown:05}.{'jpg' if args.format == 'jpeg' else 'png'}").write_bytes(answer.frame.color)
            shown += 1
            look() if shown < args.frames else upward.put(None)
