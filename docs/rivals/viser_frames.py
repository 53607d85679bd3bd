"""What a viewer gets of viser, nerfstudio's server of live views, beside the bench `viewers -- delivery`: the same frames, rendered beforehand.

    python -m venv venv && venv/bin/pip install viser opencv-python-headless
    lumisphere render --dataset teapot --component mirror --frames 32 --size 640x480 --out frames
    venv/bin/python docs/rivals/viser_frames.py frames --render-millis R

R is what a frame takes our renderer. Its stand-in draws one frame at a time: a sleep (`--renderer sleep`: as on a graphics card, viser has
the processors to itself) or as much computing as keeps every core busy for so long when nothing else runs (`--renderer work`, as lavapipe
does, which our bench renders with). The server is used as nerfstudio's viewer uses it: a callback on each new camera sets the client's background image, as JPEG, and flushes. The
client is a process of its own and speaks viser's protocol (windows of messages, zstd-packed msgpack).
"""

import argparse
import asyncio
import concurrent.futures
import hashlib
import multiprocessing
import os
import pathlib
import statistics
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
POSE_SECONDS = 0.016


def working(seconds: float):
    """A function that keeps each core busy for so long, if they are free."""
    cores, data = os.cpu_count(), bytes(1 << 16)
    pool = concurrent.futures.ThreadPoolExecutor(cores)

    def hashed(blocks: int) -> None:
        # Lets other threads of Python run.
        sink = hashlib.sha256()
        for _ in range(blocks):
            sink.update(data)

    def work(blocks: int) -> float:
        begun = time.perf_counter()
        list(pool.map(hashed, [blocks] * cores))
        return time.perf_counter() - begun

    # The best of some: others may run beside.
    blocks = int(200 * seconds / min(work(200) for _ in range(20)))
    return lambda: work(blocks)


def serve(frames: list, render_seconds: float, renderer: str, ready) -> None:
    """A frame for each camera; its position's x is the pose's number."""
    draw = working(render_seconds) if renderer == "work" else lambda: time.sleep(render_seconds)
    server = viser.ViserServer(host="127.0.0.1", port=PORT, verbose=False)
    turn = threading.Lock()

    @server.on_client_connect
    def _(client) -> None:
        @client.camera.on_update
        def _(camera) -> None:
            frame = frames[int(camera.position[0]) % len(frames)]
            if render_seconds > 0:
                with turn:
                    draw()
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
    parser.add_argument("--render-millis", type=float, default=0.0)
    parser.add_argument("--renderer", choices=["sleep", "work"], default="sleep")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--stall-seconds", type=float, default=45.0)
    arguments = parser.parse_args()
    files = sorted(arguments.frames.glob("frame-*.png"))
    frames = [cv2.cvtColor(cv2.imread(str(f)), cv2.COLOR_BGR2RGB) for f in files]
    assert frames and frames[0].shape == (480, 640, 3), "640 x 480 frames expected"

    def served(render_millis: float, client) -> None:
        context = multiprocessing.get_context("spawn")
        ready = context.Event()
        process = context.Process(target=serve, args=(frames, render_millis / 1e3, arguments.renderer, ready), daemon=True)
        process.start()
        assert ready.wait(60)
        try:
            asyncio.run(client(process.pid))
        finally:
            process.kill()
            process.join()

    print("viser", viser.__version__)
    served(0.0, lambda pid: latency(frames))
    served(arguments.render_millis, lambda pid: rate(arguments.seconds))
    served(0.0, lambda pid: stall(arguments.stall_seconds, pid))


if __name__ == "__main__":
    main()
