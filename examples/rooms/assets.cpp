#include "examples/rooms/assets.h"

#include <algorithm>
#include <array>
#include <filesystem>
#include <fstream>
#include <map>
#include <mutex>
#include <random>
#include <set>
#include <sstream>

#include "examples/rooms/obj_file.h"
#include "examples/rooms/obj_materials.h"
#include "splat/image.h"
#include "splat/image_files.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using Eigen::Matrix3d;
using Eigen::Vector3d;
using Eigen::Vector3f;
using Face = ObjFile::Face;

constexpr int kMaxTextureSide = 1024;  // larger ones are halved: no picture of a room shows more
constexpr size_t kMaxTriangles = 400000;
constexpr double kMaxShareWithoutMaterial = .5;  // of triangles; up to this they turn grey
constexpr const char* kJarName = "sweethome3d.jar";
constexpr const char* kJarFolder = "com/eteks/sweethome3d/io/";
constexpr std::array<const char*, 5> kCatalogueNames = {"BlendSwap-CC-0.sh3f",
                                                        "BlendSwap-CC-BY.sh3f", "KatorLegaz.sh3f",
                                                        "Reallusion.sh3f", "Scopia.sh3f"};

struct ModelSource {
  const CatalogueZip* zip = nullptr;
  std::string obj;                           // name of the entry
  Matrix3d rotation = Matrix3d::Identity();  // in OBJ space, before all else
};
struct TextureSource {
  const CatalogueZip* zip = nullptr;
  std::string image;
};

// ---- models.tsv: what is known of a model beyond its catalogue

std::vector<std::string> splitAt(const std::string& s, char separator) {
  std::vector<std::string> parts;
  std::istringstream in(s);
  for (std::string part; std::getline(in, part, separator);) parts.push_back(part);
  return parts;
}

struct TableRow {
  std::string split, role, fault;
};
using Table = std::map<std::string, TableRow>;

Table readTable(const std::string& path) {
  std::ifstream in(path);
  require(bool(in), "openAssets: ", path,
          ": cannot open for reading (expected the table of models)");
  Table table;
  int number = 0;
  for (std::string line; std::getline(in, line);) {
    ++number;
    if (line.empty() || line[0] == '#') continue;
    std::vector<std::string> cells = splitAt(line, '\t');
    if (cells.size() == 3) cells.emplace_back();  // nothing after the last tab
    require(cells.size() == 4, "openAssets: ", path, ":", number,
            ": expected id, split, role and fault, found ", cells.size(), " columns");
    const bool is_new = table.emplace(cells[0], TableRow{cells[1], cells[2], cells[3]}).second;
    require(is_new, "openAssets: ", path, ":", number, ": expected each id once, found ", cells[0],
            " again");
  }
  return table;
}

// ---- Images

/// Half the size, by means of 2 x 2 pixels.
Texture halved(const Texture& t) {
  Texture half;
  half.width = std::max(t.width / 2, 1), half.height = std::max(t.height / 2, 1);
  half.rgba.resize(size_t(half.width) * size_t(half.height) * 4);
  const auto at = [&](int x, int y, int c) {
    x = std::min(x, t.width - 1), y = std::min(y, t.height - 1);
    return int(t.rgba[(size_t(y) * size_t(t.width) + size_t(x)) * 4 + size_t(c)]);
  };
  for (int y = 0; y < half.height; ++y)
    for (int x = 0; x < half.width; ++x)
      for (int c = 0; c < 4; ++c)
        half.rgba[(size_t(y) * size_t(half.width) + size_t(x)) * 4 + size_t(c)] =
            uint8_t((at(2 * x, 2 * y, c) + at(2 * x + 1, 2 * y, c) + at(2 * x, 2 * y + 1, c) +
                     at(2 * x + 1, 2 * y + 1, c) + 2) /
                    4);
  return half;
}

Texture readTexture(const CatalogueZip& zip, const std::string& entry) {
  const std::string bytes = zip.read(entry), where = zip.path() + ": " + entry;
  Texture texture;
  texture.rgba =
      decodeRgba("readTexture", where, bytes.data(), bytes.size(), &texture.width, &texture.height);
  while (std::max(texture.width, texture.height) > kMaxTextureSide) texture = halved(texture);
  for (size_t i = 3; i < texture.rgba.size(); i += 4) texture.has_alpha |= texture.rgba[i] < 255;
  return texture;
}

/// Scene-linear mean, of what is covered.
Vector3f meanColour(const Texture& texture) {
  Vector3d sum = Vector3d::Zero();
  double weight = 0;
  for (size_t i = 0; i < texture.rgba.size(); i += 4) {
    const double cover = texture.rgba[i + 3] / 255.;
    for (int c = 0; c < 3; ++c)
      sum[c] += cover * double(linearFromSrgb(float(texture.rgba[i + size_t(c)]) / 255));
    weight += cover;
  }
  return weight > 0 ? Vector3f((sum / weight).cast<float>()) : Vector3f::Constant(.5f);
}

/// A material as a window's pane or a mirror, which Sweet Home 3D knows by the name of the group.
Material finished(Material m, ObjFile::Finish finish) {
  if (finish == ObjFile::Finish::kPane) {
    m.opacity = std::min(m.opacity, .3f);
    m.specular = std::max(m.specular, .04f);
    m.roughness = .05f;
  } else if (finish == ObjFile::Finish::kMirror) {
    m.colour_a.setConstant(.03f);
    m.texture = nullptr;
    m.specular = .85f;
    m.roughness = 0;
  }
  return m;
}

}  // namespace

// ---- The library

struct AssetLibrary::Impl {
  std::vector<std::unique_ptr<CatalogueZip>> zips;
  const CatalogueZip* jar = nullptr;
  std::vector<ModelInfo> models;
  std::vector<ModelSource> sources;
  std::map<std::string, size_t> by_id;
  std::vector<TextureInfo> textures;
  std::vector<TextureSource> texture_sources;

  std::mutex mutex;  // of what is kept
  std::map<size_t, std::shared_ptr<const ReadMesh>> meshes;
  std::map<std::pair<const CatalogueZip*, std::string>, std::shared_ptr<const Texture>> images;

  void addModels(const CatalogueZip& zip, const std::string& properties_name,
                 const std::string& catalogue);
  void addTextures(const CatalogueZip& zip, const std::string& properties_name);
  void applyTable(const Table& table);

  std::shared_ptr<const Texture> image(const CatalogueZip& zip, const std::string& entry);
  std::shared_ptr<const Texture> textureOf(const ModelSource& source, const tinyobj::material_t& m,
                                           std::string* note);
  Material readMaterial(const tinyobj::material_t& m, size_t model, bool has_uv, std::string* note);
  void fillMaterials(const ObjFile& obj, size_t model, ReadMesh* out);
  std::shared_ptr<const ReadMesh> readMesh(size_t model);
};

void AssetLibrary::Impl::addModels(const CatalogueZip& zip, const std::string& properties_name,
                                   const std::string& catalogue) {
  const std::string where = zip.path() + ": " + properties_name;
  const Properties properties = parseProperties(zip.read(properties_name), where);
  for (const std::string& number : entryNumbers(properties, "model")) {
    const CatalogueEntry entry{properties, number, where};
    models.push_back(readModelInfo(entry, catalogue, licenceOf(properties)));
    sources.push_back({&zip, entryName(entry.neededText("model")), readRotation(entry)});
    const bool is_new = by_id.emplace(models.back().id, models.size() - 1).second;
    require(is_new, "readCatalogue: ", where, ": expected each id once, found ", models.back().id,
            " again");
  }
}

void AssetLibrary::Impl::addTextures(const CatalogueZip& zip, const std::string& properties_name) {
  const std::string where = zip.path() + ": " + properties_name;
  const Properties properties = parseProperties(zip.read(properties_name), where);
  for (const std::string& number : entryNumbers(properties, "image")) {
    const CatalogueEntry entry{properties, number, where};
    TextureInfo info;
    info.id = entry.neededText("id");
    info.name = entry.neededText("name");
    info.category = entry.text("category");
    info.size_m = {entry.sizeM("width"), entry.sizeM("height")};
    textures.push_back(info);
    texture_sources.push_back({&zip, entryName(entry.neededText("image"))});
  }
}

void AssetLibrary::Impl::applyTable(const Table& table) {
  for (ModelInfo& model : models) {
    const auto row = table.find(model.id);
    model.role = row == table.end() ? "none" : row->second.role;
    if (row == table.end()) continue;
    model.fault = row->second.fault;
    model.is_held_out = row->second.split == "held-out";
  }
}

std::shared_ptr<const Texture> AssetLibrary::Impl::image(const CatalogueZip& zip,
                                                         const std::string& entry) {
  const std::pair<const CatalogueZip*, std::string> key(&zip, entry);
  {
    const std::lock_guard<std::mutex> lock(mutex);
    const auto found = images.find(key);
    if (found != images.end()) return found->second;
  }
  auto texture = std::make_shared<const Texture>(readTexture(zip, entry));
  const std::lock_guard<std::mutex> lock(mutex);
  return images.emplace(key, texture).first->second;
}

/// A material's texture; null, and a note, where it names one that is not there.
std::shared_ptr<const Texture> AssetLibrary::Impl::textureOf(const ModelSource& source,
                                                             const tinyobj::material_t& m,
                                                             std::string* note) {
  const std::string name = trimmed(m.diffuse_texname);
  if (name.empty()) return nullptr;
  const std::string folder = source.obj.substr(0, source.obj.size() - baseName(source.obj).size());
  const std::string entry = source.zip->locate(folder, name);
  if (entry.empty()) {
    addNote(note, "texture " + baseName(name) + " missing, diffuse colour instead");
    return nullptr;
  }
  return image(*source.zip, entry);
}

/// A material of the file, made to show; `has_uv` of whether any of its faces has coordinates.
Material AssetLibrary::Impl::readMaterial(const tinyobj::material_t& m, size_t model, bool has_uv,
                                          std::string* note) {
  Material material = plainMaterial(m, !models[model].lights.empty());
  const std::shared_ptr<const Texture> texture = textureOf(sources[model], m, note);
  if (texture && has_uv) {
    material.texture = texture;
    material.colour_a = textureFactor(m.diffuse);
  } else if (texture) {
    addNote(note, "texture without coordinates, its mean colour instead");
    material.colour_a = meanColour(*texture).cwiseMin(kMaxReflectance);
  }
  return material;
}

void AssetLibrary::Impl::fillMaterials(const ObjFile& obj, size_t model, ReadMesh* out) {
  std::set<int> has_uv;
  for (const Face& face : obj.faces)
    if (face.corner[0].uv >= 0) has_uv.insert(face.material);
  std::map<std::pair<int, ObjFile::Finish>, int32_t> index;
  size_t without = 0;  // triangles whose material is not defined
  for (const Face& face : obj.faces) {
    const int id = face.material;
    without += id == ObjFile::kUnknownMaterial;
    const auto [place, is_new] =
        index.emplace(std::pair(id, face.finish), int32_t(out->materials.size()));
    if (is_new) {
      const Material material = id >= 0 ? readMaterial(obj.materials.at(size_t(id)), model,
                                                       has_uv.count(id) > 0, &out->note)
                                        : Material();
      out->materials.push_back(finished(material, face.finish));
    }
    out->material.push_back(place->second);
  }
  if (without == 0) return;
  addNote(&out->note, joinText(without, " triangles without a material"));
  if (double(without) > kMaxShareWithoutMaterial * double(obj.faces.size()))
    out->fault = "material missing";
}

std::shared_ptr<const ReadMesh> AssetLibrary::Impl::readMesh(size_t model) {
  {
    const std::lock_guard<std::mutex> lock(mutex);
    const auto found = meshes.find(model);
    if (found != meshes.end()) return found->second;
  }
  const ModelSource& source = sources[model];
  const std::string where = source.zip->path() + ": " + source.obj;
  auto out = std::make_shared<ReadMesh>();
  ObjFile obj = readObj(*source.zip, source.obj);
  dropDegenerate(&obj, where, &out->note);
  fillGeometry(obj, modelFromObj(obj, source.rotation, models[model].size_m, where, &out->fault),
               out.get());
  fillMaterials(obj, model, out.get());
  if (obj.faces.size() > kMaxTriangles)
    out->fault = joinText("too fine: ", obj.faces.size(), " triangles");
  const std::lock_guard<std::mutex> lock(mutex);
  return meshes.emplace(model, out).first->second;
}

AssetLibrary::AssetLibrary(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
AssetLibrary::AssetLibrary(AssetLibrary&&) noexcept = default;
AssetLibrary::~AssetLibrary() = default;

std::vector<std::string> AssetLibrary::defaultFolders() {
  return {"/usr/share/sweethome3d", "/usr/local/share/sweethome3d"};
}

namespace {

/// Catalogues and jars in the folders, sorted by file name; of one name the first counts.
std::map<std::string, fs::path> catalogueFiles(const std::vector<std::string>& folders) {
  std::map<std::string, fs::path> files;
  for (const fs::path folder : folders) {
    for (const fs::path& place : {folder, folder / "furniture"}) {
      std::error_code failure;
      for (const auto& file : fs::directory_iterator(place, failure)) {
        const std::string name = file.path().filename().string();
        if (file.path().extension() == ".sh3f" || lowerCase(name) == kJarName)
          files.emplace(name, file.path());
      }
    }
  }
  return files;
}

}  // namespace

bool AssetLibrary::isInstalled() {
  const std::map<std::string, fs::path> files = catalogueFiles(defaultFolders());
  const bool has_jar = std::any_of(files.begin(), files.end(),
                                   [](const auto& f) { return lowerCase(f.first) == kJarName; });
  return has_jar && std::all_of(kCatalogueNames.begin(), kCatalogueNames.end(),
                                [&](const char* name) { return files.count(name) > 0; });
}

AssetLibrary AssetLibrary::open(const std::vector<std::string>& folders) {
  const std::map<std::string, fs::path> files = catalogueFiles(folders);
  require(!files.empty(), "openAssets: expected furniture catalogues (*.sh3f) or ", kJarName,
          ", found none: install Debian's sweethome3d and sweethome3d-furniture");
  auto impl = std::make_unique<Impl>();
  for (const auto& [name, path] : files) {
    impl->zips.push_back(std::make_unique<CatalogueZip>(path.string()));
    const CatalogueZip& zip = *impl->zips.back();
    if (path.extension() == ".sh3f") {
      impl->addModels(zip, "PluginFurnitureCatalog.properties", path.stem().string());
      continue;
    }
    impl->jar = &zip;
    impl->addModels(zip, joinText(kJarFolder, "DefaultFurnitureCatalog.properties"), "default");
    impl->addTextures(zip, joinText(kJarFolder, "DefaultTexturesCatalog.properties"));
  }
  impl->applyTable(readTable(VDBC_ROOMS_DIR "/models.tsv"));
  return AssetLibrary(std::move(impl));
}

const std::vector<ModelInfo>& AssetLibrary::models() const { return impl_->models; }

size_t AssetLibrary::find(const std::string& id) const {
  const auto found = impl_->by_id.find(id);
  require(found != impl_->by_id.end(), "findModel: expected the id of an installed model, found \"",
          id, "\"");
  return found->second;
}

std::vector<size_t> AssetLibrary::withRole(const std::string& role, bool held_out) const {
  std::vector<size_t> found;
  for (const auto& [id, i] : impl_->by_id) {
    const ModelInfo& model = impl_->models[i];
    if (model.role == role && model.is_held_out == held_out && model.fault.empty())
      found.push_back(i);
  }
  return found;
}

std::shared_ptr<const SurfaceMesh> AssetLibrary::mesh(size_t model) const {
  require(model < impl_->models.size(), "readModel: expected an index below ", impl_->models.size(),
          ", found ", model);
  return impl_->readMesh(model);
}

const std::vector<TextureInfo>& AssetLibrary::textures() const { return impl_->textures; }

std::shared_ptr<const Texture> AssetLibrary::texture(size_t index) const {
  require(index < impl_->textures.size(), "readTexture: expected an index below ",
          impl_->textures.size(), ", found ", index);
  const TextureSource& source = impl_->texture_sources[index];
  return impl_->image(*source.zip, source.image);
}

std::vector<std::string> AssetLibrary::jarFiles(const std::string& prefix) const {
  require(impl_->jar != nullptr, "readJar: expected ", kJarName,
          ", found none: install sweethome3d");
  std::vector<std::string> names;
  const auto& entries = impl_->jar->entries();
  for (auto e = entries.lower_bound(prefix); e != entries.end(); ++e) {
    if (e->first.compare(0, prefix.size(), prefix) != 0) break;
    names.push_back(e->first);
  }
  return names;
}

std::string AssetLibrary::jarFile(const std::string& name) const {
  require(impl_->jar != nullptr, "readJar: expected ", kJarName,
          ", found none: install sweethome3d");
  return impl_->jar->read(name);
}

std::string modelFault(const AssetLibrary& assets, size_t model, std::string* note) {
  try {
    // mesh() hands out nothing else.
    const auto mesh = std::static_pointer_cast<const ReadMesh>(assets.mesh(model));
    if (note) *note = mesh->note;
    return mesh->fault;
  } catch (const Error& error) {
    // The reason alone: where catalogues lie differs between machines.
    const std::string what = error.what();
    const size_t colon = what.rfind(": ");
    return colon == std::string::npos ? what : what.substr(colon + 2);
  }
}

// ---- models.tsv and attribution

namespace {

/// Held out are all of KatorLegaz, and of each role's other models a random 15 %, but at least so
/// many that both sides have some: two of the role in all where it has enough.
std::set<std::string> heldOutModels(
    const std::map<std::string, std::vector<const ModelInfo*>>& roles) {
  std::set<std::string> held_out;
  for (const auto& [role, members] : roles) {
    std::vector<std::string> others;
    int held = 0;
    for (const ModelInfo* model : members) {
      if (model->catalogue == "KatorLegaz")
        held_out.insert(model->id), ++held;
      else
        others.push_back(model->id);
    }
    std::sort(others.begin(), others.end());
    uint64_t seed = 14695981039346656037u;  // FNV-1a
    for (char c : role) seed = (seed ^ uint8_t(c)) * 1099511628211u;
    std::mt19937_64 random(seed);
    for (size_t i = others.size(); i > 1; --i) std::swap(others[i - 1], others[random() % i]);
    const int count = int(others.size());
    const int least = held == 0 ? std::min(2, (count + 1) / 3) : std::min(2 - held, count / 4);
    held_out.insert(others.begin(), others.begin() + std::max((15 * count + 50) / 100, least));
  }
  return held_out;
}

}  // namespace

std::string modelTable(const AssetLibrary& assets) {
  std::vector<std::string> faults;
  std::map<std::string, std::vector<const ModelInfo*>> roles;
  std::map<std::string, size_t> sorted;
  for (size_t i = 0; i < assets.models().size(); ++i) {
    const ModelInfo& model = assets.models()[i];
    faults.push_back(modelFault(assets, i, nullptr));
    sorted.emplace(model.id, i);
    if (faults[i].empty() && model.role != "none") roles[model.role].push_back(&model);
  }
  const std::set<std::string> held_out = heldOutModels(roles);
  std::ostringstream out;
  out << "# Models of sweethome3d and sweethome3d-furniture: id, split, role in a room, fault.\n"
         "# Roles are set by hand; split and fault are written by modelTable (assets.cpp): of what "
         "has\n"
         "# a role and no fault, all of KatorLegaz and a random 15 % of the rest of each role are "
         "held\n"
         "# out of training.\n";
  for (const auto& [id, i] : sorted) {
    const bool is_used = faults[i].empty() && assets.models()[i].role != "none";
    out << id << '\t' << (is_used ? held_out.count(id) ? "held-out" : "train" : "-") << '\t'
        << assets.models()[i].role << '\t' << faults[i] << '\n';
  }
  return out.str();
}

std::string attribution(const AssetLibrary& assets) {
  std::map<std::string, std::map<std::string, const ModelInfo*>> catalogues;
  for (const ModelInfo& model : assets.models())
    if (model.fault.empty() && model.role != "none") catalogues[model.catalogue][model.id] = &model;
  std::ostringstream out;
  for (const auto& [catalogue, members] : catalogues) {
    out << "## " << catalogue << "\n\n";
    for (const auto& [id, model] : members)
      out << "- " << model->name << " (" << id << "), " << model->creator << ", " << model->licence
          << '\n';
    out << '\n';
  }
  if (!assets.textures().empty()) {
    out << "## Textures of the default catalogue\n\n";
    for (const TextureInfo& texture : assets.textures())
      out << "- " << texture.name << " (" << texture.id << "), eTeks, GNU GPL / CC-BY 3.0\n";
  }
  return out.str();
}

}  // namespace vdbc
