# Every find_package of the project, and the one target through which LibTorch is used.

if(AJNA_BUILD_PYTHON OR NOT DEFINED Torch_DIR)
  find_package(Python 3.10 COMPONENTS Interpreter OPTIONAL_COMPONENTS Development.Module)
endif()

# LibTorch is the one inside the torch wheel of the active Python, unless Torch_DIR or CMAKE_PREFIX_PATH names another.
if(NOT DEFINED Torch_DIR AND Python_Interpreter_FOUND)
  execute_process(
    COMMAND ${Python_EXECUTABLE} -c "import torch; print(torch.utils.cmake_prefix_path)"
    OUTPUT_VARIABLE ajna_torch_prefix OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET
    RESULT_VARIABLE ajna_torch_probe)
  if(ajna_torch_probe EQUAL 0)
    list(APPEND CMAKE_PREFIX_PATH ${ajna_torch_prefix})
  endif()
endif()
find_package(Torch 2.6 QUIET)
if(NOT Torch_FOUND)
  message(FATAL_ERROR "LibTorch >= 2.6 not found: `pip install torch` into the active Python "
                      "(${Python_EXECUTABLE}) or pass -DTorch_DIR=<libtorch>/share/cmake/Torch.")
endif()

# Newer torch headers are C++20 (GCC merely warns); older ones are C++17. Ask the headers rather than keep a table.
if(NOT DEFINED AJNA_CXX_STANDARD)
  file(WRITE ${CMAKE_CURRENT_BINARY_DIR}/probe/cxx17.cpp
       "#include <c10/core/InferenceMode.h>\nint main() { return 0; }\n")
  set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
  try_compile(AJNA_TORCH_IS_CXX17 ${CMAKE_CURRENT_BINARY_DIR}/probe
              SOURCES ${CMAKE_CURRENT_BINARY_DIR}/probe/cxx17.cpp
              CMAKE_FLAGS "-DINCLUDE_DIRECTORIES=${TORCH_INCLUDE_DIRS}"
              COMPILE_DEFINITIONS -Werror=c++20-extensions
              CXX_STANDARD 17 CXX_STANDARD_REQUIRED ON)
  unset(CMAKE_TRY_COMPILE_TARGET_TYPE)
  if(AJNA_TORCH_IS_CXX17)
    set(AJNA_CXX_STANDARD 17 CACHE STRING "C++ standard: 17, or 20 where the torch headers demand it")
  else()
    set(AJNA_CXX_STANDARD 20 CACHE STRING "C++ standard: 17, or 20 where the torch headers demand it")
  endif()
endif()

add_library(ajna_torch INTERFACE)
add_library(ajna::torch ALIAS ajna_torch)
target_include_directories(ajna_torch SYSTEM INTERFACE "$<BUILD_INTERFACE:${TORCH_INCLUDE_DIRS}>")
target_link_libraries(ajna_torch INTERFACE ${TORCH_LIBRARIES})
target_compile_features(ajna_torch INTERFACE cxx_std_${AJNA_CXX_STANDARD})
get_filename_component(AJNA_TORCH_LIB_DIR "${TORCH_INSTALL_PREFIX}/lib" ABSOLUTE)

if(AJNA_BUILD_PYTHON)
  if(NOT Python_Development.Module_FOUND)
    message(FATAL_ERROR "Python headers not found: install python3-dev for ${Python_EXECUTABLE}.")
  endif()
  # Tensors cross the binding through libtorch_python, which find_package(Torch) leaves out; the pybind11
  # headers are torch's own, so that both modules share one internals version.
  find_library(AJNA_TORCH_PYTHON_LIBRARY torch_python PATHS ${AJNA_TORCH_LIB_DIR} NO_DEFAULT_PATH REQUIRED)
endif()

if(AJNA_WITH_VISION)
  find_package(OpenCV REQUIRED COMPONENTS core imgproc imgcodecs videoio)
  if(AJNA_BUILD_APPS)
    find_package(CLI11 REQUIRED)
    find_package(spdlog REQUIRED)
    find_package(yaml-cpp REQUIRED)
  endif()
endif()

if(AJNA_BUILD_TESTS)
  find_package(GTest REQUIRED)
endif()
if(AJNA_BUILD_BENCH)
  find_package(benchmark REQUIRED)
endif()
