#pragma once
// Private: tensors in files (safetensors: u64 header length, JSON header, raw little-endian data).
#include <map>
#include <string>

#include "encoder/layers.h"

namespace vdbc {

struct TensorFile {
  std::map<std::string, Tensor> tensors;        // float32, float16, int32 or int64
  std::map<std::string, std::string> metadata;  // the header's __metadata__
};

/// Temporary name, then rename. Throws Error where the file cannot be written.
void writeTensors(const TensorFile& file, const std::string& path);
/// Half floats come as float32. Throws Error on anything that is not a complete, consistent
/// safetensors file.
TensorFile readTensors(const std::string& path);

/// Parameters and buffers of a module, names prefixed.
void addModule(const torch::nn::Module& module, const std::string& prefix, TensorFile* file);
/// Copies values into the module. Throws Error unless names and shapes agree exactly.
void loadModule(torch::nn::Module& module, const std::string& prefix, const TensorFile& file,
                const std::string& path);

/// 16 hex digits that name the values of a module's parameters and buffers (FNV-1a over names and
/// bytes).
std::string weightsHash(const torch::nn::Module& module);

}  // namespace vdbc
