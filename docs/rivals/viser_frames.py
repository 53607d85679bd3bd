"""What a viewer gets of viser, nerfstudio's server of live views, beside the bench `viewers -- delivery`: the same frames.

    python -m venv venv && venv/bin/pip install viser opencv-python-headless
    lumisphere render --dataset teapot --component mirror --frames 32 --size 640x480 --out frames
    cargo bench -p lumisphere --bench render_frame --no-run
    venv/bin/python docs/rivals/viser_frames.py frames --renderer target/release/deps/render_frame-…

Pose to decoded frame, and a viewer that stalls, are measured with the frames of the folder, rendered beforehand. Frames a second with those that
our own renderer draws for each pose, one at a time, in a process of its own (render_frame's `for_another`): 64² faces, 100 points and the orbit
of the bench. The server is used as nerfstudio's viewer uses it: a callback on each new camera sets the client's background image, as
JPEG, and flushes. The client is a process of its own and speaks viser's protocol (windows of messages, zstd-packed msgpack).
"""

import argparse
import asyncio
import multiprocessing
import os
import pathlib
import statistics
import subprocess
import tempfile
import threading
import time

import cv2
import msgspec
import numpy
import viser
import websockets
import zstandard

PORT = 8199
QUALITY = 90
WARM_UP, RUNS = 8, 101
POSES = 320
POSE_SECONDS = 0.016


def drawing(program: str):
    """Frames of our own renderer, and how long it took for those so far, in milliseconds."""
    file = tempfile.NamedTemporaryFile(dir="/dev/shm")
    # As the server has glibc: what a frame frees stays for the next.
    environment = {**os.environ, "MALLOC_TRIM_THRESHOLD_": str(64 << 20), "MALLOC_MMAP_THRESHOLD_": str(128 << 10)}
    process = subprocess.Popen([program, "--bench", "64", "100", "for_another", file.name], env=environment, text=True,
                               stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    millis = []

    def draw(number: int):
        print(number, file=process.stdin, flush=True)
        line = process.stdout.readline()
        while not line.strip().replace(".", "").isdigit():
            assert line, "the renderer has ended"
            # What it says of itself.
            line = process.stdout.readline()
        millis.append(float(line))
        return numpy.fromfile(file.name, numpy.uint8).reshape(480, 640, 3)

    return draw, millis


def serve(frames: list, renderer: str | None, ready, rendered) -> None:
    """A frame for each camera; its position's x is the pose's number."""
    draw, millis = drawing(renderer) if renderer else (lambda number: frames[number % len(frames)], [])
    if renderer:
        # Makes the kernel and brings the pages of all poses, as our bench has them there.
        for number in range(POSES):
            draw(number)
        millis.clear()
    server = viser.ViserServer(host="127.0.0.1", port=PORT, verbose=False)
    turn = threading.Lock()

    @server.on_client_connect
    def _(client) -> None:
        @client.camera.on_update
        def _(camera) -> None:
            with turn:
                frame = draw(int(camera.position[0]) % POSES)
                if millis:
                    rendered.value = statistics.median(millis)
            client.scene.set_background_image(frame, format="jpeg", jpeg_quality=QUALITY)
            client.flush()

    ready.set()
    threading.Event().wait()


def pose(number: int) -> bytes:
    return msgspec.msgpack.encode({
        "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (float(number), 0.0, 0.0), "fov": 0.7,
        "near": 0.01, "far": 1000.0, "image_height": 480, "image_width": 640, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 1.0, 0.0),
    })


def pictures(raw: bytes) -> list:
    """Decoded background images of one window of messages."""
    packed = int.from_bytes(raw[8:16], "little")
    inner = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16:16 + packed]))
    images = [m["rgb_data"] for m in inner["messages"] if m["type"] == "BackgroundImageMessage" and m["rgb_data"]]
    return [cv2.imdecode(numpy.frombuffer(image, numpy.uint8), cv2.IMREAD_COLOR) for image in images]


def connected():
    return websockets.connect(
        f"ws://127.0.0.1:{PORT}", subprotocols=[f"viser-v{viser.__version__}"], compression=None, max_size=None)


async def frame(socket):
    """The next one, decoded."""
    while True:
        found = pictures(await socket.recv())
        if found:
            return found[-1]


async def first(socket) -> None:
    """The first camera opens the client; whatever comes for it is none of ours."""
    await socket.send(pose(0))
    try:
        while True:
            await asyncio.wait_for(socket.recv(), 1)
    except asyncio.TimeoutError:
        pass


def nearest(frames: list, image) -> int:
    """Which frame it is: JPEG changes it a little."""
    return min(range(len(frames)), key=lambda i: numpy.abs(frames[i].astype(int) - image[:, :, ::-1]).mean())


async def latency(frames: list) -> None:
    async with connected() as socket:
        await first(socket)
        millis = []
        for run in range(WARM_UP + RUNS):
            begun = time.perf_counter()
            await socket.send(pose(run + 1))
            image = await frame(socket)
            if run >= WARM_UP:
                millis.append(1e3 * (time.perf_counter() - begun))
            assert nearest(frames, image) == (run + 1) % len(frames), "a frame of another pose"
        millis.sort()
        print(f"pose to decoded frame: median {statistics.median(millis):.1f} ms, 95 % {millis[int(0.95 * RUNS)]:.1f} ms")


async def rate(seconds: float) -> None:
    """Two poses on their way, as our bench has two credits."""
    async with connected() as socket:
        await first(socket)
        await socket.send(pose(1))
        await socket.send(pose(2))
        begun, count = time.perf_counter(), 0
        while time.perf_counter() - begun < seconds:
            found = pictures(await socket.recv())
            # Images that another overtook in the server's buffer never come: what is missing is asked for anew.
            count += len(found)
            for k in range(len(found)):
                await socket.send(pose(3 + count + k))
        print(f"frames a second: {count / (time.perf_counter() - begun):.2f}")


def resident_bytes(pid: int) -> int:
    status = pathlib.Path(f"/proc/{pid}/status").read_text()
    return 1024 * int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1])


async def stall(seconds: float, pid: int) -> None:
    """A client that sends a pose every 16 ms and reads nothing."""
    async with connected() as socket:
        await first(socket)
        # Nothing is taken off the socket.
        socket.transport.pause_reading()
        before, begun, number = resident_bytes(pid), time.perf_counter(), 0
        middle = None
        while time.perf_counter() - begun < seconds:
            number += 1
            try:
                await asyncio.wait_for(socket.send(pose(number)), 1)
            except (asyncio.TimeoutError, websockets.ConnectionClosed):
                print(f"the server takes no more after {number} poses")
                break
            await asyncio.sleep(POSE_SECONDS)
            if middle is None and time.perf_counter() - begun > seconds / 2:
                middle = resident_bytes(pid)
        after = resident_bytes(pid)
        print(f"a client that stalls for {seconds:.0f} s, {number} poses: {(after - before) / 1e6:.1f} MB more, "
              f"{(after - (middle or after)) / 1e6:.1f} of them in the second half")
        socket.transport.abort()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", type=pathlib.Path)
    parser.add_argument("--renderer", help="render_frame's program, for frames a second")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--stall-seconds", type=float, default=45.0)
    arguments = parser.parse_args()
    files = sorted(arguments.frames.glob("frame-*.png"))
    frames = [cv2.cvtColor(cv2.imread(str(f)), cv2.COLOR_BGR2RGB) for f in files]
    assert frames and frames[0].shape == (480, 640, 3), "640 x 480 frames expected"

    def served(renderer: str | None, client) -> float:
        context = multiprocessing.get_context("spawn")
        ready, rendered = context.Event(), context.Value("d", 0.0)
        process = context.Process(target=serve, args=(frames, renderer, ready, rendered), daemon=True)
        process.start()
        assert ready.wait(600)
        try:
            asyncio.run(client(process.pid))
        finally:
            process.kill()
            process.join()
        return rendered.value

    print("viser", viser.__version__)
    served(None, lambda pid: latency(frames))
    if arguments.renderer:
        millis = served(arguments.renderer, lambda pid: rate(arguments.seconds))
        print(f"  a frame took the renderer {millis:.1f} ms")
    if arguments.stall_seconds:
        served(None, lambda pid: stall(arguments.stall_seconds, pid))


if __name__ == "__main__":
    main()
