# ajna_library(NAME SOURCES ... [PUBLIC targets...] [PRIVATE targets...])
# One small static library per folder of cpp/ajna, with the project's flags set in one place.

add_library(ajna_flags INTERFACE)
target_compile_options(ajna_flags INTERFACE
  $<$<CXX_COMPILER_ID:GNU,Clang>:-Wall;-Wextra;-Wpedantic;-Wshadow;-Wno-unknown-pragmas>
  $<$<AND:$<BOOL:${AJNA_WERROR}>,$<CXX_COMPILER_ID:GNU,Clang>>:-Werror>)

if(AJNA_SANITIZE)
  if(NOT CMAKE_CXX_COMPILER_ID MATCHES "GNU|Clang")
    message(FATAL_ERROR "AJNA_SANITIZE needs GCC or Clang, not ${CMAKE_CXX_COMPILER_ID}.")
  endif()
  # Global, so that test executables and GoogleTest's main are instrumented alike.
  add_compile_options(-fsanitize=${AJNA_SANITIZE} -fno-omit-frame-pointer -fno-sanitize-recover=all)
  add_link_options(-fsanitize=${AJNA_SANITIZE})
endif()

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
  # LibTorch's headers dominate the compile time; parse them once per library that uses them.
  if("ajna::torch" IN_LIST ARG_PUBLIC)
    target_precompile_headers(ajna_${name} PRIVATE <torch/torch.h>)
  endif()
  set_property(GLOBAL APPEND PROPERTY AJNA_LIBRARIES ajna_${name})
endfunction()
