# The LibTorch that lies inside the torch wheel of the active Python (or a LibTorch archive), as one target.
#
# Not find_package(Torch): for the CUDA wheels that config file insists on an installed CUDA toolkit, which we do not
# need (no CUDA code of our own), and it says nothing about torch_python. Used by our own build and, installed beside
# ajna-config.cmake, by consumers.
#
# In   AJNA_TORCH_ROOT   folder with include/ and lib/; default: Torch_DIR's, else the active Python's torch package
# Out  ajna::libtorch    INTERFACE target: headers (SYSTEM) and libraries
#      AJNA_TORCH_VERSION, AJNA_TORCH_PREFIX, AJNA_TORCH_LIB_DIR, AJNA_TORCH_INCLUDE_DIRS

if(NOT DEFINED AJNA_TORCH_ROOT)
  set(AJNA_TORCH_ROOT "" CACHE PATH "LibTorch folder (include/, lib/); empty: the torch package of the active Python")
endif()
set(AJNA_TORCH_PREFIX "")
if(AJNA_TORCH_ROOT)
  set(AJNA_TORCH_PREFIX ${AJNA_TORCH_ROOT})
elseif(Torch_DIR)
  get_filename_component(AJNA_TORCH_PREFIX "${Torch_DIR}/../../.." ABSOLUTE)
else()
  if(NOT Python_EXECUTABLE)
    find_package(Python 3.10 QUIET COMPONENTS Interpreter)
  endif()
  if(Python_EXECUTABLE)
    # Asked at every configure, so that a changed torch is noticed; find_spec does not import (and pay for) torch.
    execute_process(
      COMMAND ${Python_EXECUTABLE} -c
              "import importlib.util as u, os; print(os.path.dirname(u.find_spec('torch').origin))"
      OUTPUT_VARIABLE AJNA_TORCH_PREFIX OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET)
  endif()
endif()

set(AJNA_TORCH_VERSION "")
if(AJNA_TORCH_PREFIX)
  foreach(_ajna_header include/torch/headeronly/version.h include/torch/csrc/api/include/torch/version.h)
    if(EXISTS "${AJNA_TORCH_PREFIX}/${_ajna_header}" AND NOT AJNA_TORCH_VERSION)
      file(STRINGS "${AJNA_TORCH_PREFIX}/${_ajna_header}" _ajna_lines REGEX "define TORCH_VERSION_(MAJOR|MINOR|PATCH) ")
      if("${_ajna_lines}" MATCHES "MAJOR ([0-9]+).*MINOR ([0-9]+).*PATCH ([0-9]+)")
        set(AJNA_TORCH_VERSION "${CMAKE_MATCH_1}.${CMAKE_MATCH_2}.${CMAKE_MATCH_3}")
      endif()
    endif()
  endforeach()
endif()
set(AJNA_TORCH_LIB_DIR "${AJNA_TORCH_PREFIX}/lib")
set(AJNA_TORCH_INCLUDE_DIRS "${AJNA_TORCH_PREFIX}/include" "${AJNA_TORCH_PREFIX}/include/torch/csrc/api/include")
if(EXISTS "${AJNA_TORCH_LIB_DIR}/libtorch_cpu.so")
  set(AJNA_TORCH_LIBRARY "${AJNA_TORCH_LIB_DIR}/libtorch_cpu.so")
else()
  set(AJNA_TORCH_LIBRARY "")
endif()

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(AjnaLibTorch
  REQUIRED_VARS AJNA_TORCH_LIBRARY AJNA_TORCH_PREFIX
  VERSION_VAR AJNA_TORCH_VERSION
  REASON_FAILURE_MESSAGE
    "no torch in '${Python_EXECUTABLE}': `pip install torch` there, or pass -DAJNA_TORCH_ROOT=<libtorch folder>.")

if(AjnaLibTorch_FOUND AND NOT TARGET ajna::libtorch)
  add_library(ajna::libtorch INTERFACE IMPORTED)
  # libtorch.so holds no symbols, but loading it registers the CUDA kernels of a CUDA wheel: keep it although unused.
  set_target_properties(ajna::libtorch PROPERTIES
    INTERFACE_INCLUDE_DIRECTORIES "${AJNA_TORCH_INCLUDE_DIRS}"
    INTERFACE_SYSTEM_INCLUDE_DIRECTORIES "${AJNA_TORCH_INCLUDE_DIRS}"
    INTERFACE_LINK_LIBRARIES "-Wl,--push-state,--no-as-needed,${AJNA_TORCH_LIB_DIR}/libtorch.so,--pop-state;\
${AJNA_TORCH_LIBRARY};${AJNA_TORCH_LIB_DIR}/libc10.so")
  if(EXISTS "${AJNA_TORCH_LIB_DIR}/libtorch_cuda.so")
    # Its own needs (cudart, cudnn, the driver) are other wheels' or the driver's, found at run time.
    set_property(TARGET ajna::libtorch PROPERTY INTERFACE_LINK_OPTIONS "-Wl,--allow-shlib-undefined")
  endif()
endif()
