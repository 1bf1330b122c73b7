#pragma once
// A completion that was cut short goes on where it stopped: a .latent.vdb after every growth level.
#include <string>

#include "mar/completer.h"

namespace vdbc {

/// What has to be equal for one completion to go on where another stopped (JSON): the completer,
/// what it starts from and all settings that an option changes (identityOptions).
std::string completionIdentity(const Completer& completer, const Place& start,
                               const CompleteSettings& settings);

/// Writes the place so far and the next level. Throws Error where the file cannot be written.
void writeCheckpoint(const Place& so_far, int32_t next_level, const std::string& identity,
                     const std::string& path);

/// The place so far instead of `start`; sets `settings->first_level` and `begun_with`. Throws Error
/// unless the file is there and of this identity and encoder.
void readCheckpoint(const std::string& path, const std::string& identity, Place* start,
                    CompleteSettings* settings);

}  // namespace vdbc
