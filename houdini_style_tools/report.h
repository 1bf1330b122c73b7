#pragma once
// What a verb says on stdout, for people or for programs.
#include <nlohmann/json_fwd.hpp>
#include <string>

namespace vdbc {

/// With `json` the object in one line, otherwise `text`.
void printResult(bool json, const nlohmann::ordered_json& result, const std::string& text);
/// With `json` the object in one line, otherwise a line a value.
void printValues(bool json, const nlohmann::ordered_json& values);

}  // namespace vdbc
