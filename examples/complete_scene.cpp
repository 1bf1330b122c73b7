// The main job as a library: complete_scene VIEWS WEIGHTS_FOLDER NAME writes NAME.vdb and its
// siblings.
#include <cstdio>

#include "encoder/views/read_views.h"
#include "houdini_style_tools/complete.h"

int main(int argc, char** argv) try {
  if (argc != 4) throw vdbc::UsageError("usage: complete_scene VIEWS WEIGHTS_FOLDER NAME");
  using namespace vdbc;
  const std::vector<View> views = readViews(argv[1]);
  const Encoder encoder(std::string(argv[2]) + "/encoder.safetensors");
  const Completer completer(std::string(argv[2]) + "/completer.safetensors");
  SceneSettings settings;
  settings.observing.volume.up = conventionalUp(argv[1]);
  Progress silent;
  const Place place = completeScene(views, encoder, completer, settings, silent);
  writePlace(place, views, encoder, settings, argv[3], silent);
} catch (const std::exception& e) {
  std::fprintf(stderr, "%s\n", e.what());
  return 1;
}
