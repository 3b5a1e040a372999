# Runs cargo, asks rustc which libraries of the system a static link needs, and lays the results out.
# Called by CMakeLists.txt at build time, with everything as -D definitions.

cmake_minimum_required(VERSION 3.18)

# RUSTFLAGS and cargo's configuration are the caller's: what this build needs is passed to rustc for
# this crate alone.
set(rustc_args --print native-static-libs -C strip=debuginfo)
if(SONAME_ARG)
  list(APPEND rustc_args -C "link-arg=${SONAME_ARG}")
endif()
execute_process(
  COMMAND "${CARGO}" rustc --release --lib --locked --manifest-path "${MANIFEST}" --target-dir "${TARGET_DIR}"
    --no-default-features --features "${FEATURES}" -- ${rustc_args}
  RESULT_VARIABLE result
  ERROR_VARIABLE messages
  ECHO_ERROR_VARIABLE)
if(NOT result EQUAL 0)
  message(FATAL_ERROR "cargo failed")
endif()
if(NOT messages MATCHES "native-static-libs: ([^\n\r]*)")
  message(FATAL_ERROR "rustc named no native-static-libs")
endif()
string(STRIP "${CMAKE_MATCH_1}" native)

set(built "${TARGET_DIR}/release")
if(DEFINED ENV{CARGO_BUILD_TARGET})
  set(built "${TARGET_DIR}/$ENV{CARGO_BUILD_TARGET}/release")
endif()

# Copies without touching a file that is the same, so that nothing is linked again without need.
function(lay_out from to)
  execute_process(COMMAND "${CMAKE_COMMAND}" -E copy_if_different "${built}/${from}" "${LIB_DIR}/${to}"
    RESULT_VARIABLE result)
  if(NOT result EQUAL 0)
    message(FATAL_ERROR "${built}/${from} could not be copied")
  endif()
endfunction()

file(MAKE_DIRECTORY "${LIB_DIR}")
lay_out("${LINK_NAME}" "${SHARED_NAME}")
lay_out("${STATIC_NAME}" "${STATIC_NAME}")
if(IMPLIB_NAME)
  lay_out("${IMPLIB_NAME}" "${IMPLIB_NAME}")
endif()
if(SONAME)
  foreach(link IN ITEMS "${SONAME}" "${LINK_NAME}")
    file(CREATE_LINK "${SHARED_NAME}" "${LIB_DIR}/${link}" SYMBOLIC)
  endforeach()
endif()

file(WRITE "${LIB_DIR}/native.rsp" "${native}\n")
string(REPLACE " " ";" native_list "${native}")
file(WRITE "${NATIVE_LIBRARIES}" "set(bakelite_NATIVE_LIBRARIES \"${native_list}\")\n")
configure_file("${PC_IN}" "${PC_OUT}" @ONLY)
