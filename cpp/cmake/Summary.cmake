message(STATUS "ajna ${PROJECT_VERSION}: ${CMAKE_BUILD_TYPE}, C++${AJNA_CXX_STANDARD}, "
               "torch ${AJNA_TORCH_VERSION} (${AJNA_TORCH_PREFIX})")
message(STATUS "  vision ${AJNA_WITH_VISION}, python ${AJNA_BUILD_PYTHON}, tests ${AJNA_BUILD_TESTS}, apps ${AJNA_BUILD_APPS}, "
               "bench ${AJNA_BUILD_BENCH}, sanitize '${AJNA_SANITIZE}', werror ${AJNA_WERROR}")
