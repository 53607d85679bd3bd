// OpenImageIO's texture system on the requests of the bench `texture_cache`: CPU seconds and bytes. Debian's 2.4 (its smallest cache is 1 MB).
//   g++ -O3 -march=native docs/rivals/oiio_textures.cpp -lOpenImageIO -lOpenImageIO_Util -o target/oiio_textures
//   target/oiio_textures FOLDER FACES SIZE CACHE_FACES
// FOLDER has faces.f32 (FACES faces of SIZE × SIZE RGB, f32), random.u32 and warm.u32 (face, x, y of bilinear look-ups). Prints one line a
// measurement: name, value.
#include <OpenImageIO/imagecache.h>
#include <OpenImageIO/imageio.h>
#include <OpenImageIO/texture.h>

#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <string>
#include <vector>

using namespace OIIO;

static double cpu_seconds() {
  timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return double(t.tv_sec) + 1e-9 * double(t.tv_nsec);
}

template <class T> static std::vector<T> read_all(const std::string& path) {
  std::ifstream file(path, std::ios::binary | std::ios::ate);
  if (!file) { std::fprintf(stderr, "cannot read %s\n", path.c_str()); std::exit(1); }
  std::vector<T> values(size_t(file.tellg()) / sizeof(T));
  file.seekg(0);
  file.read(reinterpret_cast<char*>(values.data()), std::streamsize(values.size() * sizeof(T)));
  return values;
}

struct Layout { const char* name; const char* compression; int tile; TypeDesc type; };

static std::string path_of(const std::string& folder, const Layout& layout, int face) {
  return folder + "/" + layout.name + "/" + std::to_string(face) + ".exr";
}

// One face a file, one file a face: a tile of the face's size is then a page.
static void write_faces(const std::string& folder, const Layout& layout, const std::vector<float>& texels, int faces, int size) {
  std::filesystem::create_directories(folder + "/" + layout.name);
  for (int face = 0; face < faces; ++face) {
    ImageSpec spec(size, size, 3, layout.type);
    spec.tile_width = spec.tile_height = layout.tile ? layout.tile : size;
    spec.attribute("compression", layout.compression);
    auto out = ImageOutput::create("exr");
    const std::string path = path_of(folder, layout, face);
    if (!out || !out->open(path, spec) || !out->write_image(TypeDesc::FLOAT, &texels[size_t(face) * size * size * 3]) || !out->close()) {
      std::fprintf(stderr, "cannot write %s\n", path.c_str());
      std::exit(1);
    }
  }
}

static TextureSystem* system_of(double megabytes) {
  TextureSystem* system = TextureSystem::create(false);
  system->attribute("max_memory_MB", float(megabytes));
  system->attribute("max_open_files", 100000);
  system->attribute("trust_file_extensions", 1);
  system->attribute("automip", 0);
  return system;
}

static double look_up_all(TextureSystem* system, const std::vector<ustring>& names, const std::vector<uint32_t>& look_ups, int size, double& sum) {
  TextureOpt options;
  options.interpmode = TextureOpt::InterpBilinear;
  options.mipmode = TextureOpt::MipModeNoMIP;
  options.swrap = options.twrap = TextureOpt::WrapClamp;
  auto* thread = system->get_perthread_info();
  std::vector<TextureSystem::TextureHandle*> handles;
  for (const ustring& name : names) handles.push_back(system->get_texture_handle(name));
  sum = 0;
  const double start = cpu_seconds();
  for (size_t i = 0; i + 2 < look_ups.size(); i += 3) {
    float rgb[3];
    // The middle of the four texels from (x, y) on.
    const float s = float(look_ups[i + 1] + 1) / float(size), t = float(look_ups[i + 2] + 1) / float(size);
    if (!system->texture(handles[look_ups[i]], thread, options, s, t, 0, 0, 0, 0, 3, rgb)) {
      std::fprintf(stderr, "%s\n", system->geterror().c_str());
      std::exit(1);
    }
    sum += rgb[0];
  }
  return cpu_seconds() - start;
}

int main(int argc, char** argv) {
  if (argc != 5) return 2;
  const std::string folder = argv[1];
  const int faces = std::atoi(argv[2]), size = std::atoi(argv[3]);
  const double cache_mb = (std::atof(argv[4]) + 0.5) * size * size * 12 / 1048576.0;
  OIIO::attribute("threads", 1);
  OIIO::attribute("exr_threads", -1);
  const auto texels = read_all<float>(folder + "/faces.f32");
  const auto random = read_all<uint32_t>(folder + "/random.u32");
  const auto warm = read_all<uint32_t>(folder + "/warm.u32");
  std::printf("version %s\n", OIIO_VERSION_STRING);
  const Layout layouts[] = {
      {"zip_f32", "zip", 0, TypeDesc::FLOAT},
      {"none_f32", "none", 0, TypeDesc::FLOAT},
      {"zip_f32_32", "zip", 32, TypeDesc::FLOAT},
      {"zip_f16", "zip", 0, TypeDesc::HALF},
  };
  for (const Layout& layout : layouts) {
    write_faces(folder, layout, texels, faces, size);
    double bytes = 0;
    std::vector<ustring> names;
    for (int face = 0; face < faces; ++face) {
      names.emplace_back(path_of(folder, layout, face));
      bytes += double(std::filesystem::file_size(names.back().string()));
    }
    std::printf("%s_bytes %.0f\n", layout.name, bytes);
    double sum;
    TextureSystem* system = system_of(cache_mb);
    // Headers are read and files opened before the clock starts.
    for (const ustring& name : names) { ImageSpec spec; system->get_imagespec(name, 0, spec); }
    const double seconds = look_up_all(system, names, random, size, sum);
    long long misses = 0;
    system->getattribute("stat:tiles_created", TypeDesc::INT64, &misses);
    int created = 0;
    if (!misses && system->getattribute("stat:tiles_created", created)) misses = created;
    std::printf("%s_seconds %.6f\n%s_misses %lld\n%s_sum %.6f\n", layout.name, seconds, layout.name, misses, layout.name, sum);
    TextureSystem::destroy(system);
    if (std::string(layout.name) == "zip_f32") {
      TextureSystem* ample = system_of(4096);
      look_up_all(ample, names, warm, size, sum);
      double best = 1e30;
      for (int run = 0; run < 5; ++run) best = std::min(best, look_up_all(ample, names, warm, size, sum));
      std::printf("hit_nanoseconds %.3f\nhit_sum %.6f\n", 1e9 * best / (double(warm.size()) / 3), sum);
      TextureSystem::destroy(ample);
    }
  }
}
