# ajna_library(NAME SOURCES ... [PUBLIC targets...] [PRIVATE targets...])
# One small static library per folder of cpp/ajna, with the project's flags set in one place.

add_library(ajna_flags INTERFACE)
target_compile_options(ajna_flags INTERFACE
  $<$<CXX_COMPILER_ID:GNU,Clang>:-Wall;-Wextra;-Wpedantic;-Wshadow;-Wno-unknown-pragmas>
  $<$<CXX_COMPILER_ID:GNU>:-Wno-restrict>  # GCC 12 warns of `"a" + std::string` itself (its bug 105651)
  $<$<AND:$<BOOL:${AJNA_WERROR}>,$<CXX_COMPILER_ID:GNU,Clang>>:-Werror>)

if(AJNA_SANITIZE)
  if(NOT CMAKE_CXX_COMPILER_ID MATCHES "GNU|Clang")
    message(FATAL_ERROR "AJNA_SANITIZE needs GCC or Clang, not ${CMAKE_CXX_COMPILER_ID}.")
  endif()
  # Global, so that test executables and GoogleTest's main are instrumented alike.
  add_compile_options(-fsanitize=${AJNA_SANITIZE} -fno-omit-frame-pointer -fno-sanitize-recover=all)
  add_link_options(-fsanitize=${AJNA_SANITIZE})
endif()
# Bounds checks of the standard library in Debug builds.
add_compile_definitions($<$<CONFIG:Debug>:_GLIBCXX_ASSERTIONS>)

# LibTorch's headers dominate the compile time. They are parsed once, here; but GCC instantiates the templates that they
# leave pending anew in every source (9 s for an empty one), so sources are also compiled several at a time.
file(WRITE ${PROJECT_BINARY_DIR}/cpp/torch_pch.cpp "// Carries the precompiled header of all LibTorch targets.\n")
add_library(ajna_torch_pch OBJECT ${PROJECT_BINARY_DIR}/cpp/torch_pch.cpp)
target_link_libraries(ajna_torch_pch PRIVATE ajna::torch ajna_flags)
target_precompile_headers(ajna_torch_pch PRIVATE <torch/torch.h>)

# ajna_use_torch_pch(TARGET): share that precompiled header. GCC uses it for equal flags only, -Wpedantic included, as
# that changes a predefined macro.
function(ajna_use_torch_pch target)
  target_link_libraries(${target} PRIVATE $<BUILD_INTERFACE:ajna_flags>)
  target_precompile_headers(${target} REUSE_FROM ajna_torch_pch)
  get_target_property(type ${target} TYPE)
  if(type STREQUAL "EXECUTABLE")
    # The header is compiled with -fPIC, and GCC rejects it for code compiled with -fPIE.
    set_target_properties(${target} PROPERTIES POSITION_INDEPENDENT_CODE OFF)
    target_compile_options(${target} PRIVATE -fPIC)
  endif()
  ajna_compile_together(${target})
endfunction()

# ajna_compile_together(TARGET): few large sources instead of many small ones, unless AJNA_UNITY_BUILD is off.
function(ajna_compile_together target)
  set_target_properties(${target} PROPERTIES UNITY_BUILD ${AJNA_UNITY_BUILD} UNITY_BUILD_BATCH_SIZE 6)
endfunction()

# ajna_exposes_torch(OUT targets...): whether any of the targets passes LibTorch's headers on to its users.
function(ajna_exposes_torch out)
  get_property(torch_libraries GLOBAL PROPERTY AJNA_TORCH_LIBRARIES)
  set(${out} FALSE PARENT_SCOPE)
  foreach(target IN LISTS ARGN)
    if(target STREQUAL "ajna::torch" OR target IN_LIST torch_libraries)
      set(${out} TRUE PARENT_SCOPE)
    endif()
  endforeach()
endfunction()

function(ajna_library name)
  cmake_parse_arguments(ARG "" "" "SOURCES;PUBLIC;PRIVATE" ${ARGN})
  add_library(ajna_${name} STATIC ${ARG_SOURCES})
  add_library(ajna::${name} ALIAS ajna_${name})
  set_target_properties(ajna_${name} PROPERTIES EXPORT_NAME ${name})
  target_include_directories(ajna_${name} PUBLIC
    $<BUILD_INTERFACE:${PROJECT_SOURCE_DIR}/cpp>
    $<BUILD_INTERFACE:${PROJECT_BINARY_DIR}/cpp>
    $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}>)
  target_compile_features(ajna_${name} PUBLIC cxx_std_${AJNA_CXX_STANDARD})
  target_link_libraries(ajna_${name} PUBLIC ${ARG_PUBLIC} PRIVATE ${ARG_PRIVATE} $<BUILD_INTERFACE:ajna_flags>)
  ajna_exposes_torch(passes_torch_on ${ARG_PUBLIC})
  ajna_exposes_torch(uses_torch ${ARG_PUBLIC} ${ARG_PRIVATE})
  if(passes_torch_on)
    set_property(GLOBAL APPEND PROPERTY AJNA_TORCH_LIBRARIES ajna::${name})
  endif()
  if(uses_torch)
    ajna_use_torch_pch(ajna_${name})
  endif()
  set_property(GLOBAL APPEND PROPERTY AJNA_LIBRARIES ajna_${name})
endfunction()
