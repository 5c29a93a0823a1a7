message(STATUS "ajna ${PROJECT_VERSION}: ${CMAKE_BUILD_TYPE}, C++${AJNA_CXX_STANDARD}, "
               "torch ${AJNA_TORCH_VERSION} (${AJNA_TORCH_PREFIX})")
message(STATUS "  vision ${AJNA_WITH_VISION}, python ${AJNA_BUILD_PYTHON}, tests ${AJNA_BUILD_TESTS}, apps ${AJNA_BUILD_APPS}, "
               "bench ${AJNA_BUILD_BENCH}, sanitize '${AJNA_SANITIZE}', werror ${AJNA_WERROR}")
if(AJNA_WITH_FLIGHT)
  message(STATUS "  flight: on (MAVLink headers by pymavlink ${AJNA_MAVLINK_VERSION})")
else()
  message(STATUS "  flight: off (AJNA_BUILD_FLIGHT=${AJNA_BUILD_FLIGHT}; needs vision, apps and `pip install pymavlink`)")
endif()
