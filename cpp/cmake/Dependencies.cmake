# Every find_package of the project, and the one target through which LibTorch is used.

# `make` keeps its virtual environment in .venv: let a bare `cmake --preset release` find the torch in there as well.
if(NOT DEFINED Python_EXECUTABLE AND NOT DEFINED ENV{VIRTUAL_ENV} AND EXISTS ${PROJECT_SOURCE_DIR}/.venv/bin/python)
  set(Python_EXECUTABLE ${PROJECT_SOURCE_DIR}/.venv/bin/python)
endif()
find_package(Python 3.10 COMPONENTS Interpreter OPTIONAL_COMPONENTS Development.Module)

find_package(AjnaLibTorch 2.6 REQUIRED)

# Newer torch headers are C++20 (GCC merely warns); older ones are C++17. Ask the headers rather than keep a table.
if(NOT "${AJNA_TORCH_VERSION} ${AJNA_TORCH_PREFIX}" STREQUAL "${AJNA_CXX_STANDARD_PROBED_FOR}")
  file(WRITE ${CMAKE_CURRENT_BINARY_DIR}/probe/cxx17.cpp
       "#include <c10/core/InferenceMode.h>\nint main() { return 0; }\n")
  unset(AJNA_TORCH_IS_CXX17 CACHE)
  set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
  try_compile(AJNA_TORCH_IS_CXX17 ${CMAKE_CURRENT_BINARY_DIR}/probe
              SOURCES ${CMAKE_CURRENT_BINARY_DIR}/probe/cxx17.cpp
              CMAKE_FLAGS "-DINCLUDE_DIRECTORIES=${AJNA_TORCH_INCLUDE_DIRS}"
              COMPILE_DEFINITIONS -Werror=c++20-extensions
              CXX_STANDARD 17 CXX_STANDARD_REQUIRED ON)
  unset(CMAKE_TRY_COMPILE_TARGET_TYPE)
  set(AJNA_CXX_STANDARD_PROBED_FOR "${AJNA_TORCH_VERSION} ${AJNA_TORCH_PREFIX}" CACHE INTERNAL "")
  if(AJNA_TORCH_IS_CXX17)
    set(AJNA_CXX_STANDARD_PROBED 17 CACHE INTERNAL "")
  else()
    set(AJNA_CXX_STANDARD_PROBED 20 CACHE INTERNAL "")
  endif()
endif()
if(NOT AJNA_CXX_STANDARD)
  set(AJNA_CXX_STANDARD ${AJNA_CXX_STANDARD_PROBED})
endif()

add_library(ajna_torch INTERFACE)
add_library(ajna::torch ALIAS ajna_torch)
set_target_properties(ajna_torch PROPERTIES EXPORT_NAME torch)
# In the build tree and in an installed one alike the wheel's files come through FindAjnaLibTorch.
target_link_libraries(ajna_torch INTERFACE ajna::libtorch)
target_compile_features(ajna_torch INTERFACE cxx_std_${AJNA_CXX_STANDARD})

if(AJNA_BUILD_PYTHON)
  if(NOT Python_Development.Module_FOUND)
    message(FATAL_ERROR "Python headers not found: install python3-dev for ${Python_EXECUTABLE}.")
  endif()
  # Tensors cross the binding through libtorch_python; the pybind11 headers are torch's own, so that both modules
  # share one internals version.
  set(AJNA_TORCH_PYTHON_LIBRARY ${AJNA_TORCH_LIB_DIR}/libtorch_python.so)
  if(NOT EXISTS ${AJNA_TORCH_PYTHON_LIBRARY})
    message(FATAL_ERROR "${AJNA_TORCH_PYTHON_LIBRARY} not found: AJNA_BUILD_PYTHON needs the torch of a Python "
                        "(`pip install torch`), not a LibTorch archive.")
  endif()
endif()

set(AJNA_WITH_FLIGHT OFF)
if(AJNA_WITH_VISION)
  find_package(OpenCV REQUIRED COMPONENTS calib3d core imgproc imgcodecs video videoio)
  find_package(Eigen3 3.4 REQUIRED NO_MODULE)
  if(AJNA_BUILD_APPS)
    find_package(CLI11 REQUIRED)
    find_package(spdlog REQUIRED)
    find_package(yaml-cpp REQUIRED)
    if(AJNA_BUILD_FLIGHT)
      if(AJNA_BUILD_FLIGHT STREQUAL "AUTO")
        find_package(AjnaMavlink QUIET)
      else()
        find_package(AjnaMavlink REQUIRED)
      endif()
      set(AJNA_WITH_FLIGHT ${AjnaMavlink_FOUND})
      find_package(Threads REQUIRED)
    endif()
  endif()
endif()

if(AJNA_BUILD_TESTS)
  find_package(GTest REQUIRED)
endif()
if(AJNA_BUILD_BENCH)
  find_package(benchmark REQUIRED)
endif()
