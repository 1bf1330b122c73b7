#include "vdb/process.h"

#include <cstdlib>
#include <fstream>
#include <limits>
#include <string>

namespace vdbc {

double peakMemoryMb() {
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);)
    if (line.rfind("VmHWM:", 0) == 0) return std::atof(line.c_str() + 6) / 1024;
  return std::numeric_limits<double>::quiet_NaN();
}

// The kernel keeps the peak; writing 5 to clear_refs starts it afresh.
void resetPeakMemory() { std::ofstream("/proc/self/clear_refs") << "5"; }

}  // namespace vdbc
