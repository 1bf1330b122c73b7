#pragma once
// Furniture and textures from Sweet Home 3D's Debian packages: catalogues (.sh3f, and the one in
// sweethome3d.jar), read in place. Nothing of them is in this repository but their names.
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "examples/rooms/surface.h"

namespace vdbc {

/// A lamp inside a model.
struct ModelLight {
  Eigen::Vector3f centre = Eigen::Vector3f::Zero();  // model frame, metres
  Eigen::Vector3f colour = Eigen::Vector3f::Ones();  // scene-linear, 0-1
  float diameter_m = .05f;
};

/// One catalogue entry. The model frame: x to the right of someone who stands behind it, y towards
/// its front, z up, origin in the middle of its footprint at its lowest point, metres.
struct ModelInfo {
  std::string id, name, catalogue, category, creator, licence;
  std::string role;                                  // models.tsv: what a room uses it as
  Eigen::Vector3f size_m = Eigen::Vector3f::Zero();  // x width, y depth, z height
  float elevation_m = 0;                             // where it hangs by default
  float top_m = 0;                                   // height at which things stand on it
  bool is_door_or_window = false;
  bool is_held_out = false;  // models.tsv: never in training rooms
  std::string fault;         // models.tsv: why it is not used; empty: usable
  std::vector<ModelLight> lights;
};

/// A texture of the jar's catalogue.
struct TextureInfo {
  std::string id, name, category;  // category: Floor, Wall, Sky, ...
  Eigen::Vector2f size_m = Eigen::Vector2f::Zero();
};

/// The catalogues on this machine. Cheap to open: geometry is read on first use and kept; every
/// const function may be called from several threads.
class AssetLibrary {
 public:
  /// Opens every *.sh3f and sweethome3d.jar in `folders` (and in their furniture/), and the
  /// repository's models.tsv. Throws Error where a catalogue is unreadable, or where there is no
  /// catalogue at all (saying how to get it).
  static AssetLibrary open(const std::vector<std::string>& folders = defaultFolders());
  /// /usr/share/sweethome3d and /usr/local/share/sweethome3d.
  static std::vector<std::string> defaultFolders();
  /// Whether the catalogues and the jar that rooms are made from are there.
  static bool isInstalled();

  AssetLibrary(AssetLibrary&&) noexcept;
  ~AssetLibrary();

  const std::vector<ModelInfo>& models() const;
  /// Index of a model by id ("Scopia#bathroom3"). Throws Error if there is none.
  size_t find(const std::string& id) const;
  /// Usable models of `role`, held out or not; sorted by id.
  std::vector<size_t> withRole(const std::string& role, bool held_out) const;
  /// Geometry in the model frame, scaled to the catalogue's size. Throws Error if it is broken.
  std::shared_ptr<const SurfaceMesh> mesh(size_t model) const;

  const std::vector<TextureInfo>& textures() const;
  std::shared_ptr<const Texture> texture(size_t index) const;

  /// A file of the jar (examples' homes): its names, sorted, and their bytes. Throws Error.
  std::vector<std::string> jarFiles(const std::string& prefix) const;
  std::string jarFile(const std::string& name) const;

 private:
  struct Impl;
  explicit AssetLibrary(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

/// What is wrong with a model, found by reading it: "" if nothing is. `note` tells of what was
/// mended (a missing texture replaced by the diffuse colour, degenerate triangles dropped).
std::string modelFault(const AssetLibrary& assets, size_t model, std::string* note);

/// models.tsv of these catalogues: id, split, role and fault of every model, one line each.
std::string modelTable(const AssetLibrary& assets);

/// Attribution of every model and texture used, one line each, from the catalogues:
/// docs/ATTRIBUTION.md.
std::string attribution(const AssetLibrary& assets);

/// models.tsv anew: roles as they are in it, faults found by reading every model, the split drawn.
std::string modelTable(const AssetLibrary& assets);

}  // namespace vdbc
