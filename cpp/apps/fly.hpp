// SPDX-License-Identifier: MIT
#pragma once

#include <string>

namespace ajna::apps {

/// Read and validate a configuration, and see that the files it names are there. Throws Error.
void check_config(const std::string& path);

/// Fly by a configuration until SIGTERM, SIGINT or SIGHUP, or the end of a recording. dry_run: nothing is ever sent.
/// Returns the process's exit code; throws Error for what is wrong before the flight begins.
int fly(const std::string& config_path, bool dry_run);

}  // namespace ajna::apps
