// The rival of benches/path_tracer.rs: Embree 3.13 on the same triangles and the same rays, one thread.
//
//   apt-get install libembree-dev
//   g++ -O3 -march=native docs/rivals/embree_primary.cpp -lembree3 -o target/embree_primary
//
// Usage: embree_primary TRIANGLES RAYS WIDTH. TRIANGLES: 9 f32 each (three corners). RAYS: 6 f32 each (origin, direction), WIDTH to a
// row. Prints one line: rays/s of rtcIntersect1 and of packets of eight (2 rows x 4, coherent), both the median of several runs
// of processor time, then how many rays hit and the sum of their distances, so that the caller can check that both see the same.

#include <embree3/rtcore.h>
#include <pmmintrin.h>
#include <time.h>
#include <xmmintrin.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <limits>
#include <vector>

static std::vector<float> read_floats(const char* path) {
  FILE* file = std::fopen(path, "rb");
  if (!file) { std::perror(path); std::exit(1); }
  std::fseek(file, 0, SEEK_END);
  std::vector<float> values(std::ftell(file) / sizeof(float));
  std::rewind(file);
  if (std::fread(values.data(), sizeof(float), values.size(), file) != values.size()) { std::perror(path); std::exit(1); }
  std::fclose(file);
  return values;
}

static double processor_seconds() {
  timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

static double median_seconds(const std::function<void()>& run) {
  run();
  std::vector<double> seconds;
  for (int i = 0; i < 9; ++i) {
    double start = processor_seconds();
    run();
    seconds.push_back(processor_seconds() - start);
  }
  std::nth_element(seconds.begin(), seconds.begin() + 4, seconds.end());
  return seconds[4];
}

int main(int argc, char** argv) {
  if (argc != 4) { std::fprintf(stderr, "usage: embree_primary TRIANGLES RAYS WIDTH\n"); return 2; }
  _MM_SET_FLUSH_ZERO_MODE(_MM_FLUSH_ZERO_ON);
  _MM_SET_DENORMALS_ZERO_MODE(_MM_DENORMALS_ZERO_ON);
  std::vector<float> corners = read_floats(argv[1]), rays = read_floats(argv[2]);
  size_t triangles = corners.size() / 9, count = rays.size() / 6, width = std::atoi(argv[3]);

  RTCDevice device = rtcNewDevice("threads=1");
  RTCScene scene = rtcNewScene(device);
  rtcSetSceneBuildQuality(scene, RTC_BUILD_QUALITY_HIGH);
  RTCGeometry mesh = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
  float* vertices = (float*)rtcSetNewGeometryBuffer(mesh, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, 3 * triangles);
  std::copy(corners.begin(), corners.end(), vertices);
  unsigned* indices = (unsigned*)rtcSetNewGeometryBuffer(mesh, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, triangles);
  for (size_t i = 0; i < 3 * triangles; ++i) indices[i] = i;
  rtcCommitGeometry(mesh);
  rtcAttachGeometry(scene, mesh);
  rtcCommitScene(scene);

  size_t hits = 0;
  double distances = 0;
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  double single = median_seconds([&] {
    hits = 0;
    distances = 0;
    for (size_t i = 0; i < count; ++i) {
      const float* r = &rays[6 * i];
      RTCRayHit ray{};
      ray.ray.org_x = r[0]; ray.ray.org_y = r[1]; ray.ray.org_z = r[2];
      ray.ray.dir_x = r[3]; ray.ray.dir_y = r[4]; ray.ray.dir_z = r[5];
      ray.ray.tfar = std::numeric_limits<float>::infinity();
      ray.ray.mask = ~0u;
      ray.hit.geomID = RTC_INVALID_GEOMETRY_ID;
      rtcIntersect1(scene, &context, &ray);
      if (ray.hit.geomID != RTC_INVALID_GEOMETRY_ID) { ++hits; distances += ray.ray.tfar; }
    }
  });

  double packets = median_seconds([&] {
    alignas(32) int valid[8] = {-1, -1, -1, -1, -1, -1, -1, -1};
    for (size_t row = 0; row + 1 < count / width; row += 2)
      for (size_t column = 0; column + 3 < width; column += 4) {
        alignas(32) RTCRayHit8 packet{};
        for (int lane = 0; lane < 8; ++lane) {
          const float* r = &rays[6 * ((row + lane / 4) * width + column + lane % 4)];
          packet.ray.org_x[lane] = r[0]; packet.ray.org_y[lane] = r[1]; packet.ray.org_z[lane] = r[2];
          packet.ray.dir_x[lane] = r[3]; packet.ray.dir_y[lane] = r[4]; packet.ray.dir_z[lane] = r[5];
          packet.ray.tfar[lane] = std::numeric_limits<float>::infinity();
          packet.ray.mask[lane] = ~0u;
          packet.hit.geomID[lane] = RTC_INVALID_GEOMETRY_ID;
        }
        rtcIntersect8(valid, scene, &context, &packet);
      }
  });

  std::printf("%.0f %.0f %zu %.6f\n", count / single, count / packets, hits, distances);
  rtcReleaseGeometry(mesh);
  rtcReleaseScene(scene);
  rtcReleaseDevice(device);
}
