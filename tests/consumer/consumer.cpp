// SPDX-License-Identifier: MIT
// engine and io through the installed headers alone, which need no LibTorch header: loads the model that is named, runs
// it on two frames and writes the flow; without a model the error must be the library's own.
#include <cstdio>

#include "ajna/base/error.hpp"
#include "ajna/base/version.hpp"
#include "ajna/engine/flow_engine.hpp"
#ifdef CONSUMER_HAS_IO
#include "ajna/io/image_io.hpp"
#endif

int main(int argc, char** argv) {
  const ajna::Image black(64, 48);
  try {
    const auto engine = ajna::engine::FlowEngine::load(argc > 1 ? argv[1] : "no-such-model.safetensors");
    const auto field = engine.infer(black.view(), black.view());
    std::printf("ajna %s: %d x %d\n", ajna::kVersion, field.width, field.height);
    return field.width == black.width() && field.height == black.height() ? 0 : 1;
  } catch (const ajna::Error& error) {
    std::printf("ajna %s: %s\n", ajna::kVersion, error.what());
    if (argc > 1 || error.kind() != ajna::ErrorKind::kFileNotFound) {
      return 1;
    }
  }
#ifdef CONSUMER_HAS_IO
  try {
    ajna::io::read_image("no-such-image.png");
    return 1;
  } catch (const ajna::Error& error) {
    std::printf("%s\n", error.what());
  }
#endif
  return 0;
}
