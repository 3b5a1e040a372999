# Runs cargo, asks rustc which libraries of the system a static link needs, and lays the results out. Called by
# CMakeLists.txt at build time with -DPROFILE, -DLIB_DIR and -DSETTINGS (see settings.cmake.in).

cmake_minimum_required(VERSION 3.18)
include("${SETTINGS}")

# RUSTFLAGS and cargo's configuration are the caller's: what this build needs is passed to rustc for this crate alone.
set(rustc_args --print native-static-libs)
if(PROFILE STREQUAL "release")
  # Of the shared library; what it exports stays.
  list(APPEND rustc_args -C strip=symbols)
endif()
foreach(arg IN LISTS LINKER_ARGS)
  list(APPEND rustc_args -C "link-arg=${arg}")
endforeach()
set(cargo_args ${CARGO_ARGS})
if(RUST_TARGET)
  list(APPEND cargo_args --target "${RUST_TARGET}")
  if(LINKER)
    string(TOUPPER "${RUST_TARGET}" variable)
    string(REPLACE "-" "_" variable "${variable}")
    set(ENV{CARGO_TARGET_${variable}_LINKER} "${LINKER}")
  endif()
else()
  # CMake's toolchain decides.
  unset(ENV{CARGO_BUILD_TARGET})
endif()
execute_process(
  COMMAND "${CARGO}" rustc --profile "${PROFILE}" --lib --crate-type "${CRATE_TYPES}" --locked
    --manifest-path "${MANIFEST}" --target-dir "${TARGET_DIR}" --no-default-features --features "${FEATURES}"
    ${cargo_args} -- ${rustc_args}
  RESULT_VARIABLE result
  ERROR_VARIABLE messages
  ECHO_ERROR_VARIABLE)
if(NOT result EQUAL 0)
  message(FATAL_ERROR "cargo failed")
endif()

set(built "${TARGET_DIR}")
if(RUST_TARGET)
  string(APPEND built "/${RUST_TARGET}")
endif()
if(PROFILE STREQUAL "dev")
  string(APPEND built "/debug")
else()
  string(APPEND built "/${PROFILE}")
endif()

# Copies without touching a file that is the same, so that nothing is linked again without need.
function(lay_out from to)
  execute_process(COMMAND "${CMAKE_COMMAND}" -E copy_if_different "${from}" "${LIB_DIR}/${to}"
    RESULT_VARIABLE result)
  if(NOT result EQUAL 0)
    message(FATAL_ERROR "${from} could not be copied")
  endif()
endfunction()

function(run)
  execute_process(COMMAND ${ARGN} RESULT_VARIABLE result ERROR_VARIABLE complaint)
  if(NOT result EQUAL 0)
    message(FATAL_ERROR "${ARGV0} failed: ${complaint}")
  endif()
endfunction()

# Links an archive to one object with what the functions of bakelite.h need, as a fresh archive in `dir`. That is an
# eighth of the size, since most of Rust's library and of the solver for unwrapping is not needed; and what is not part
# of the header is local, so that a program can link other libraries written in Rust as well. Functions keep sections of
# their own: what a program does not call, its linker leaves out.
function(slim_down archive dir)
  file(MAKE_DIRECTORY "${dir}")
  # The sections .llvm... hold the compiler's intermediate code.
  run("${OBJCOPY}" --strip-debug --remove-section=.llvmbc --remove-section=.llvmcmd "${archive}" "${dir}/stripped.a")
  execute_process(COMMAND "${NM}" -g --defined-only "${dir}/stripped.a" OUTPUT_VARIABLE symbols ERROR_QUIET)
  string(REGEX MATCHALL " T _?bk_[a-z0-9_]+" symbols "${symbols}")
  if(NOT symbols)
    message(FATAL_ERROR "${NM} finds no function of bakelite.h in ${archive}")
  endif()
  list(TRANSFORM symbols REPLACE " T " "--undefined=")
  run("${LD}" -r --gc-sections ${symbols} -o "${dir}/bakelite.o" "${dir}/stripped.a")
  run("${OBJCOPY}" --wildcard --keep-global-symbol=bk_* "${dir}/bakelite.o")
  run("${AR}" rcsD "${dir}/${STATIC_NAME}" "${dir}/bakelite.o")
endfunction()

file(MAKE_DIRECTORY "${LIB_DIR}")
if(WITH_SHARED)
  lay_out("${built}/${CARGO_SHARED_NAME}" "${SHARED_NAME}")
  if(IMPLIB_NAME)
    lay_out("${built}/${IMPLIB_NAME}" "${IMPLIB_NAME}")
  endif()
  if(SONAME)
    foreach(link IN ITEMS "${SONAME}" "${CARGO_SHARED_NAME}")
      file(CREATE_LINK "${SHARED_NAME}" "${LIB_DIR}/${link}" SYMBOLIC)
    endforeach()
  endif()
endif()

set(native "")
if(WITH_STATIC)
  set(archive "${built}/${STATIC_NAME}")
  if(PROFILE STREQUAL "release" AND SLIM STREQUAL "one object")
    slim_down("${archive}" "${LIB_DIR}/slim")
    set(archive "${LIB_DIR}/slim/${STATIC_NAME}")
  elseif(PROFILE STREQUAL "release" AND SLIM STREQUAL "strip")
    # Rust's own library comes with lines for debuggers.
    run("${STRIP}" -S -o "${LIB_DIR}/slim.a" "${archive}")
    set(archive "${LIB_DIR}/slim.a")
  endif()
  lay_out("${archive}" "${STATIC_NAME}")
  file(REMOVE_RECURSE "${LIB_DIR}/slim" "${LIB_DIR}/slim.a")

  if(NOT messages MATCHES "native-static-libs: ([^\n\r]*)")
    message(FATAL_ERROR "rustc named no native-static-libs")
  endif()
  string(STRIP "${CMAKE_MATCH_1}" native)
  # A C compiler adds the C library and its own by itself, and only so the static ones when it is told -static.
  string(REGEX REPLACE "(^| )-l(gcc_s|c)( |$)" "\\1\\3" native "${native}")
  string(REGEX REPLACE "(^| )-l(gcc_s|c)( |$)" "\\1\\3" native "${native}")
  string(REGEX REPLACE " +" " " native "${native}")
  string(STRIP "${native}" native)
endif()
file(WRITE "${LIB_DIR}/native.rsp" "${native}\n")
string(REPLACE " " ";" native_list "${native}")
string(REPLACE "," ";" feature_list "${FEATURES}")
file(WRITE "${LIB_DIR}/bakeliteNativeLibraries.cmake"
  "set(bakelite_NATIVE_LIBRARIES \"${native_list}\")\nset(bakelite_FEATURES \"${feature_list}\")\n")

# Where there is no shared library, every link is a static one.
set(libs "-L\${libdir} -lbakelite")
set(libs_private "${native}")
set(cflags "")
if(NOT WITH_SHARED)
  string(APPEND libs " ${native}")
  set(libs_private "")
  set(cflags " -DBK_STATIC")
endif()
configure_file("${PC_IN}" "${LIB_DIR}/bakelite.pc" @ONLY)
