# The build itself under test: installation and find_package(ajna), and the build without OpenCV. Each keeps its build
# folder, so that a second run only compiles what changed.
if(AJNA_SANITIZE)
  return()
endif()

set(consumer ${PROJECT_BINARY_DIR}/consumer)
add_test(NAME package.install COMMAND ${CMAKE_COMMAND} --install ${PROJECT_BINARY_DIR} --prefix ${consumer}/prefix)
set_tests_properties(package.install PROPERTIES FIXTURES_SETUP installed)
foreach(program consumer torch_consumer)
  add_test(NAME package.${program} COMMAND ${CMAKE_CTEST_COMMAND}
    --build-and-test ${PROJECT_SOURCE_DIR}/tests/consumer ${consumer}/build
    --build-generator ${CMAKE_GENERATOR} --build-target ${program}
    --build-options -DCMAKE_PREFIX_PATH=${consumer}/prefix -DPython_EXECUTABLE=${Python_EXECUTABLE}
    --test-command ${program})
endforeach()
# One build folder: not both at once.
set_tests_properties(package.consumer package.torch_consumer PROPERTIES
  FIXTURES_REQUIRED installed RESOURCE_LOCK consumer TIMEOUT 600 LABELS slow)

if(AJNA_BUILD_PYTHON AND AJNA_WITH_VISION)
  add_test(NAME package.without_vision COMMAND ${Python_EXECUTABLE} ${CMAKE_CURRENT_LIST_DIR}/minimal_build.py
    ${PROJECT_SOURCE_DIR} ${PROJECT_BINARY_DIR}/minimal)
  set_tests_properties(package.without_vision PROPERTIES TIMEOUT 1500 LABELS slow)
endif()
