# The MAVLink 2 C headers of the ArduPilot dialect, generated once per build folder by the active Python's pymavlink.
#
# pymavlink's wheel carries the official XML definitions (mavlink/mavlink, MIT) beside its generator; the C code that
# comes out is MIT-licensed too. Nothing of pymavlink itself is linked, installed or needed at run time.
#
# In   AJNA_MAVLINK_ROOT    folder that holds mavlink/ardupilotmega/mavlink.h: headers generated elsewhere (cross
#                           builds, machines without Python); default: generate
# Out  ajna::mavlink        INTERFACE target: headers (SYSTEM)
#      AJNA_MAVLINK_VERSION version of the pymavlink that generated them, or "given"

set(AJNA_MAVLINK_ROOT "" CACHE PATH "Folder with mavlink/ardupilotmega/mavlink.h; empty: generate with pymavlink")
set(AJNA_MAVLINK_INCLUDE_DIR "")
set(AJNA_MAVLINK_VERSION "")
if(AJNA_MAVLINK_ROOT)
  if(EXISTS "${AJNA_MAVLINK_ROOT}/mavlink/ardupilotmega/mavlink.h")
    set(AJNA_MAVLINK_INCLUDE_DIR "${AJNA_MAVLINK_ROOT}")
    set(AJNA_MAVLINK_VERSION given)
  endif()
elseif(Python_EXECUTABLE)
  # find_spec does not import; asked at every configure, so that a changed pymavlink is noticed.
  execute_process(
    COMMAND ${Python_EXECUTABLE} -c
            "import importlib.metadata as m, importlib.util as u, os; \
print(os.path.dirname(u.find_spec('pymavlink').origin) + ';' + m.version('pymavlink'))"
    OUTPUT_VARIABLE _ajna_pymavlink OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET)
  if(_ajna_pymavlink)
    list(GET _ajna_pymavlink 0 _ajna_folder)
    list(GET _ajna_pymavlink 1 _ajna_version)
    set(_ajna_generated ${PROJECT_BINARY_DIR}/generated)
    set(_ajna_stamp ${_ajna_generated}/pymavlink-${_ajna_version}.stamp)
    if(NOT EXISTS ${_ajna_stamp})
      message(STATUS "Generating MAVLink headers with pymavlink ${_ajna_version}")
      file(REMOVE_RECURSE ${_ajna_generated})
      # --no-validate: the schema check would need lxml and looks at XML that has been released.
      execute_process(
        COMMAND ${Python_EXECUTABLE} -m pymavlink.tools.mavgen --lang=C --wire-protocol=2.0 --no-validate
                --output=${_ajna_generated}/mavlink ${_ajna_folder}/dialects/v20/ardupilotmega.xml
        RESULT_VARIABLE _ajna_result OUTPUT_VARIABLE _ajna_output ERROR_VARIABLE _ajna_output)
      if(_ajna_result EQUAL 0 AND EXISTS ${_ajna_generated}/mavlink/ardupilotmega/mavlink.h)
        file(TOUCH ${_ajna_stamp})
      else()
        message(WARNING "pymavlink ${_ajna_version} of ${Python_EXECUTABLE} could not generate its headers:\n"
                        "${_ajna_output}")
      endif()
    endif()
    if(EXISTS ${_ajna_stamp})
      set(AJNA_MAVLINK_INCLUDE_DIR ${_ajna_generated})
      set(AJNA_MAVLINK_VERSION ${_ajna_version})
    endif()
  endif()
endif()

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(AjnaMavlink
  REQUIRED_VARS AJNA_MAVLINK_INCLUDE_DIR
  VERSION_VAR AJNA_MAVLINK_VERSION
  REASON_FAILURE_MESSAGE
    "no pymavlink in '${Python_EXECUTABLE}': `pip install pymavlink` there, or pass -DAJNA_MAVLINK_ROOT=<folder>.")

if(AjnaMavlink_FOUND AND NOT TARGET ajna::mavlink)
  add_library(ajna::mavlink INTERFACE IMPORTED)
  set_target_properties(ajna::mavlink PROPERTIES
    INTERFACE_INCLUDE_DIRECTORIES "${AJNA_MAVLINK_INCLUDE_DIR}"
    INTERFACE_SYSTEM_INCLUDE_DIRECTORIES "${AJNA_MAVLINK_INCLUDE_DIR}")
endif()
