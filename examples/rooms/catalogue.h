#pragma once
// Private to assets: Sweet Home 3D's catalogues, which are properties files in zips.
#include <Eigen/Core>
#include <map>
#include <optional>
#include <string>
#include <unordered_map>
#include <vector>

#include "encoder/views/zip_file.h"
#include "examples/rooms/assets.h"

namespace vdbc {

std::string lowerCase(std::string s);
std::string trimmed(const std::string& s);
/// What is behind the last slash of either kind: texture paths come from any system.
std::string baseName(const std::string& path);

/// A zip file whose entries refer to each other by name.
class CatalogueZip : public ZipFile {
 public:
  explicit CatalogueZip(const std::string& path);

  /// Name of the entry `file` refers to, seen from `folder` ("" or ending in a slash): its path;
  /// else its base name, in any case, in the folder; else the only entry of that base name. "" if
  /// none.
  std::string locate(const std::string& folder, const std::string& file) const;
  std::string read(const std::string& name) const;

 private:
  std::unordered_map<std::string, std::vector<std::string>> by_base_;
};

/// Keys and values of a Java properties file, as UTF-8. `where` names the file.
using Properties = std::map<std::string, std::string>;
Properties parseProperties(const std::string& text, const std::string& where);
/// Numbers of a catalogue's entries, in order: those that have `key`.
std::vector<std::string> entryNumbers(const Properties& properties, const std::string& key);
std::string licenceOf(const Properties& properties);

/// One numbered entry of a catalogue: its properties without the number, and how to complain.
struct CatalogueEntry {
  const Properties& properties;
  std::string number, where;

  const std::string* find(const std::string& key) const;
  std::string text(const std::string& key) const;
  std::string neededText(const std::string& key) const;
  std::vector<double> numbers(const std::string& key) const;
  double number1(const std::string& key, std::optional<double> otherwise = {}) const;
  float sizeM(const std::string& key) const;
};

ModelInfo readModelInfo(const CatalogueEntry& entry, const std::string& catalogue,
                        const std::string& licence);
/// Of a model, in OBJ space.
Eigen::Matrix3d readRotation(const CatalogueEntry& entry);
/// Path of a catalogue as the name of a zip entry: without its leading slash.
std::string entryName(const std::string& path);

}  // namespace vdbc
