# `cmake --install` gives libraries, headers and ajna-config.cmake (component `dev`); the Python extension is a
# component of its own, which only the wheel installs.
include(CMakePackageConfigHelpers)

set(ajna_cmake_dir ${CMAKE_INSTALL_LIBDIR}/cmake/ajna)
get_property(ajna_libraries GLOBAL PROPERTY AJNA_LIBRARIES)

install(TARGETS ${ajna_libraries} ajna_torch EXPORT ajnaTargets
        ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT dev)
install(EXPORT ajnaTargets NAMESPACE ajna:: DESTINATION ${ajna_cmake_dir} COMPONENT dev)

# Headers of the libraries that were built, no others.
foreach(library IN LISTS ajna_libraries)
  string(REGEX REPLACE "^ajna_" "" name ${library})
  install(DIRECTORY ${PROJECT_SOURCE_DIR}/cpp/ajna/${name} DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}/ajna COMPONENT dev
          FILES_MATCHING PATTERN "*.hpp")
endforeach()
install(FILES ${PROJECT_BINARY_DIR}/cpp/ajna/base/version.hpp
        DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}/ajna/base COMPONENT dev)

configure_package_config_file(${PROJECT_SOURCE_DIR}/cpp/cmake/ajna-config.cmake.in
  ${PROJECT_BINARY_DIR}/ajna-config.cmake INSTALL_DESTINATION ${ajna_cmake_dir})
write_basic_package_version_file(${PROJECT_BINARY_DIR}/ajna-config-version.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${PROJECT_BINARY_DIR}/ajna-config.cmake ${PROJECT_BINARY_DIR}/ajna-config-version.cmake
              ${PROJECT_SOURCE_DIR}/cpp/cmake/FindAjnaLibTorch.cmake
        DESTINATION ${ajna_cmake_dir} COMPONENT dev)

# Installed programs find LibTorch where it was linked.
if(TARGET ajna_flight_program)
  set_target_properties(ajna_flight_program PROPERTIES INSTALL_RPATH_USE_LINK_PATH ON)
endif()
