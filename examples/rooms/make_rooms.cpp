// make_rooms: procedural rooms as folders of RGB-D views, with their true surface as a mesh.
// FOLDER/SEED/{transforms.json,color,depth,mesh.ply} and FOLDER/sheet.png, a picture of each room.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <string>
#include <vector>

#include "examples/rooms/rooms.h"
#include "vdb/error.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

constexpr uint64_t kMaxRooms = 100000;
constexpr int kTileSide = 224, kSheetColumns = 6;

struct Options {
  std::string seeds, output;
  int views = 8, samples = 16;
  std::vector<int> size{224};  // width, or width and height
};

struct SeedRange {
  uint64_t first = 0, last = 0;
};

// "A" or "A-B".
SeedRange seedRange(const std::string& text) {
  unsigned long long first = 0, last = 0;
  int used = 0;
  const bool digits = !text.empty() && text.find_first_not_of("0123456789-") == std::string::npos &&
                      text.front() != '-';
  const int found =
      digits ? std::sscanf(text.c_str(), "%llu%n-%llu%n", &first, &used, &last, &used) : 0;
  if (found == 1) last = first;
  if (found < 1 || size_t(used) != text.size() || last < first || last - first >= kMaxRooms)
    throw UsageError(joinText("--seeds: ", text, ": expected a seed or a range such as 10-19"));
  return {first, last};
}

// Binary PLY, world frame, metres.
void writeMesh(const TriangleMesh& mesh, const std::string& path) {
  std::string bytes =
      joinText("ply\nformat binary_little_endian 1.0\nelement vertex ", mesh.vertices.size(),
               "\nproperty float x\nproperty float y\nproperty float z\nelement face ",
               mesh.triangles.size(), "\nproperty list uchar int vertex_indices\nend_header\n");
  for (const Eigen::Vector3f& v : mesh.vertices)
    bytes.append(reinterpret_cast<const char*>(v.data()), 3 * sizeof(float));
  for (const Eigen::Vector3i& t : mesh.triangles) {
    bytes.push_back(3);
    bytes.append(reinterpret_cast<const char*>(t.data()), 3 * sizeof(int32_t));
  }
  writeFile("make_rooms", path, bytes.data(), bytes.size());
}

void paste(const Image& from, int x0, int y0, Image* to) {
  for (int y = 0; y < from.height; ++y)
    for (int x = 0; x < from.width; ++x)
      for (int c = 0; c < 3; ++c) to->at(x0 + x, y0 + y, c) = from.at(x, y, c);
}

// One picture a room, in rows.
Image contactSheet(const std::vector<Image>& pictures) {
  const int count = int(pictures.size()), columns = std::min(count, kSheetColumns);
  const int rows = (count + columns - 1) / columns, w = pictures[0].width, h = pictures[0].height;
  Image sheet(columns * w, rows * h, 3, .15f);
  for (int i = 0; i < count; ++i)
    paste(pictures[size_t(i)], i % columns * w, i / columns * h, &sheet);
  return sheet;
}

void run(const Options& o) {
  const SeedRange seeds = seedRange(o.seeds);
  const int width = o.size.front(), height = o.size.back();
  std::vector<Image> pictures;
  for (uint64_t seed = seeds.first;; ++seed) {
    const Room room = makeRoom(seed);
    const RoomRenderer renderer(room);
    std::mt19937_64 random(seed);
    std::vector<View> views;
    for (const Camera& camera : randomCameras(room, o.views, width, height, random))
      views.push_back(renderer.render(camera, o.samples, seed + views.size()));
    const std::string folder = o.output + "/" + std::to_string(seed);
    writeViews(views, folder);
    writeMesh(room.mesh, folder + "/mesh.ply");
    const int tile_height = std::max(1, int(std::lround(double(kTileSide) * height / width)));
    pictures.push_back(resizeImage(views[0].colour, kTileSide, tile_height));
    if (seed == seeds.last) break;  // the last seed may be the largest there is
  }
  writePng(contactSheet(pictures), o.output + "/sheet.png");
}

}  // namespace
}  // namespace vdbc

int main(int argc, char** argv) {
  vdbc::Options o;
  CLI::App app{"Procedural rooms as folders of RGB-D views with their true surface.", "make_rooms"};
  app.add_option("--seeds", o.seeds, "the rooms, A-B; the same seed gives the same room")
      ->required();
  app.add_option("--views", o.views, "pictures a room")
      ->check(CLI::Range(1, 1000))
      ->capture_default_str();
  app.add_option("-o,--output", o.output,
                 "folder for SEED/transforms.json, SEED/mesh.ply and sheet.png")
      ->required();
  app.add_option("--size", o.size, "pixels: width, or width and height")
      ->expected(1, 2)
      ->check(CLI::Range(8, 4096))
      ->capture_default_str();
  app.add_option("--samples", o.samples, "render samples a pixel")
      ->check(CLI::Range(1, 4096))
      ->capture_default_str();
  try {
    app.parse(argc, argv);
    vdbc::run(o);
    return 0;
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? 0 : 2;
  } catch (const vdbc::UsageError& e) {
    std::fprintf(stderr, "make_rooms: %s\n", e.what());
    return 2;
  } catch (const std::exception& e) {
    std::fprintf(stderr, "make_rooms: %s\n", e.what());
    return 1;
  }
}
