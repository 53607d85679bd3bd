"""OpenImageIO's image cache, current release, on the random requests of the bench `texture_cache`: CPU seconds of the misses.

    python3 -m venv target/oiio && target/oiio/bin/pip install OpenImageIO==3.2.2.0 numpy
    target/oiio/bin/python docs/rivals/oiio_misses.py FOLDER FACES SIZE CACHE_FACES

Reads the EXR files that oiio_textures wrote. Through Python a hit costs microseconds, so only misses are of use here; the smallest
cache is 10 MB. Prints one line a measurement: name, value.
"""

import sys
import time

import numpy
import OpenImageIO as oiio

folder, faces, size, cache_faces = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
oiio.attribute("threads", 1)
oiio.attribute("exr_threads", -1)
print("version", oiio.__version__)
requests = numpy.fromfile(f"{folder}/random.u32", dtype=numpy.uint32).reshape(-1, 3).tolist()
for layout in ["zip_f32", "none_f32", "zip_f32_32"]:
    cache = oiio.ImageCache(False)
    cache.attribute("max_memory_MB", (cache_faces + 0.5) * size * size * 12 / 2**20)
    cache.attribute("max_open_files", 100000)
    cache.attribute("trust_file_extensions", 1)
    names = [f"{folder}/{layout}/{face}.exr" for face in range(faces)]
    for name in names:
        cache.get_imagespec(name)
    start = time.process_time()
    total = 0.0
    for face, x, y in requests:
        pixels = cache.get_pixels(names[face], 0, 0, x, x + 2, y, y + 2)
        total += float(pixels[..., 0].mean())
    seconds = time.process_time() - start
    # The same calls with everything in the cache: what Python itself takes.
    face, x, y = requests[-1]
    start = time.process_time()
    for _ in requests:
        float(cache.get_pixels(names[face], 0, 0, x, x + 2, y, y + 2)[..., 0].mean())
    overhead = time.process_time() - start
    print(f"{layout}_seconds {seconds - overhead:.6f}\n{layout}_misses {cache.getattribute('stat:tiles_created')}\n{layout}_sum {total:.6f}")
