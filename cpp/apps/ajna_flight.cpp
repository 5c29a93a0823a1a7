// SPDX-License-Identifier: MIT
//
// The onboard program. `--config` flies (see docs/flight.md); `--model --frames --dry-run` only measures a folder of
// frames. stdout carries JSON, stderr everything that is meant for people.
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>

#include <CLI/CLI.hpp>
#include <exception>
#include <string>

#include "ajna/base/memory.hpp"
#include "ajna/base/version.hpp"
#include "apps/fly.hpp"
#include "apps/frames_report.hpp"

namespace {

constexpr int kBadInput = 2;

int fail(const std::string& message) {
  spdlog::error("{}", message);
  return kBadInput;
}

struct Options {
  std::string config;
  bool check_config = false;
  bool dry_run = false;
  ajna::apps::FramesOptions frames;
};

int run_config(const Options& options) {
  if (!options.frames.model.empty() || !options.frames.frames.empty()) {
    return fail("--config says all of a flight: leave --model and --frames out (see --help)");
  }
  if (options.check_config) {
    ajna::apps::check_config(options.config);
    spdlog::info("configuration '{}' is valid", options.config);
    return 0;
  }
  return ajna::apps::fly(options.config, options.dry_run);
}

int run_frames(const Options& options) {
  if (options.check_config) {
    return fail("--check-config needs --config FILE (see --help)");
  }
  if (options.frames.model.empty()) {
    return fail("--model is required, or --config for a flight (see --help)");
  }
  if (options.frames.frames.empty()) {
    return fail("--frames is required, or --config for a flight (see --help)");
  }
  if (!options.dry_run) {
    return fail("with --frames the program sends nothing to an autopilot: run it with --dry-run, or fly with --config");
  }
  ajna::apps::report_frames(options.frames);
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  ajna::keep_freed_memory();
  auto logger = spdlog::stderr_color_mt("ajna_flight");
  logger->set_pattern("%n: %^%l%$: %v");
  spdlog::set_default_logger(logger);

  Options options;
  CLI::App app{
      "Flies a task next to an ArduPilot autopilot, or measures a folder of frames.\n"
      "Example: ajna_flight --config flight.yaml\n"
      "Example: ajna_flight --model ajna.safetensors --frames frames/ --dry-run"};
  app.set_version_flag("--version", ajna::kVersion);
  app.add_option("--config", options.config, "Configuration of a flight (YAML; docs/flight.yaml is a commented one)");
  app.add_flag("--check-config", options.check_config, "Only check the configuration");
  app.add_flag("--dry-run", options.dry_run, "Send nothing to an autopilot");
  app.add_option("--model", options.frames.model, "Checkpoint (.safetensors) or TorchScript file (.pt, .torchscript)");
  app.add_option("--frames", options.frames.frames, "Folder of images, taken in natural order of their names");
  app.add_option("--threads", options.frames.engine.threads, "Threads of the network; by default LibTorch's choice")
      ->check(CLI::Range(1, 1024));
  app.add_option("--device", options.frames.engine.device, "cpu, cuda or cuda:<index>")->capture_default_str();
  app.add_option("--size", options.frames.size, "Resize the frames first, as WIDTHxHEIGHT");
  app.add_option("--max-frames", options.frames.max_frames, "Use only so many frames")
      ->check(CLI::Range(std::int64_t{2}, std::int64_t{1} << 40));
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return error.get_exit_code() == 0 ? app.exit(error) : fail(std::string(error.what()) + " (see --help)");
  }
  int result = 0;
  try {
    result = options.config.empty() ? run_frames(options) : run_config(options);
  } catch (const std::exception& error) {
    result = fail(error.what());
  }
  spdlog::shutdown();  // writes what is still queued
  return result;
}
