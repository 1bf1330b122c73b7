#include "encoder/process_group.h"

#include <torch/csrc/distributed/c10d/PrefixStore.hpp>
#include <torch/csrc/distributed/c10d/ProcessGroupGloo.hpp>
#include <torch/csrc/distributed/c10d/TCPStore.hpp>

#include "vdb/error.h"

namespace vdbc {

struct ProcessGroup::Impl {
  c10::intrusive_ptr<c10d::ProcessGroupGloo> gloo;
};

namespace {

constexpr std::chrono::minutes kPatience(
    5);  // a validation of the first process takes tens of seconds

std::shared_ptr<gloo::transport::Device> device(const std::string& address) {
  if (const char* interface = std::getenv("GLOO_SOCKET_IFNAME"))
    return c10d::ProcessGroupGloo::createDeviceForInterface(interface);
  if (address == "localhost" || address.rfind("127.", 0) == 0)
    return c10d::ProcessGroupGloo::createDeviceForHostname("127.0.0.1");
  return c10d::ProcessGroupGloo::createDefaultDevice();
}

}  // namespace

ProcessGroup::ProcessGroup(const TrainProcesses& p) : rank_(p.rank), size_(p.size) {
  require(p.size >= 1 && p.rank >= 0 && p.rank < p.size, "train: expected a rank in [0, ", p.size,
          "), found ", p.rank);
  if (size_ == 1) return;
  try {
    c10d::TCPStoreOptions options;
    options.port = p.port, options.isServer = p.rank == 0, options.timeout = kPatience;
    auto store = c10::make_intrusive<c10d::TCPStore>(p.address, options);
    auto gloo_options = c10d::ProcessGroupGloo::Options::create();
    gloo_options->devices.push_back(device(p.address)), gloo_options->timeout = kPatience;
    impl_ = std::make_unique<Impl>();
    impl_->gloo = c10::make_intrusive<c10d::ProcessGroupGloo>(store, rank_, size_, gloo_options);
  } catch (const std::exception& e) {
    throw Error(joinText("train: process ", p.rank, " of ", p.size, ": cannot meet the others at ",
                         p.address, ":", p.port, ": ", firstLine(e)));
  }
}

ProcessGroup::~ProcessGroup() = default;

void ProcessGroup::sum(Tensor* values) {
  if (size_ == 1) return;
  std::vector<Tensor> one{*values};
  try {
    impl_->gloo->allreduce(one)->wait();
  } catch (const std::exception& e) {
    throw Error(
        joinText("train: process ", rank_, " of ", size_, ": lost the others: ", firstLine(e)));
  }
}

}  // namespace vdbc
