# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# `cmake --install`: the program, the shared library with its one header, and what find_package(vla) and pkg-config read.

include(CMakePackageConfigHelpers)

# Libraries that lie beside libvla.so go before the system's, also for what they need themselves: a Python wheel carries them.
set_target_properties(vla_shared PROPERTIES INSTALL_RPATH "$ORIGIN")
set_target_properties(vla PROPERTIES INSTALL_RPATH "$ORIGIN/../${CMAKE_INSTALL_LIBDIR}")
target_link_options(vla_shared PRIVATE -Wl,--disable-new-dtags)
target_link_options(vla PRIVATE -Wl,--disable-new-dtags)

install(TARGETS vla RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR} COMPONENT program)
if(VLA_BUILD_SERVER)  # where `vla serve` looks for it; a Python wheel has it beside vla
  set_target_properties(vla_door_lerobot PROPERTIES INSTALL_RPATH
                        "$ORIGIN/../../${CMAKE_INSTALL_LIBDIR}:$ORIGIN/../${CMAKE_INSTALL_LIBDIR}")
  target_link_options(vla_door_lerobot PRIVATE -Wl,--disable-new-dtags)
  install(TARGETS vla_door_lerobot RUNTIME DESTINATION libexec/vla COMPONENT program)
endif()
install(TARGETS vla_shared EXPORT vlaTargets
        LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT library NAMELINK_COMPONENT development)
if(VLA_BUILD_SERVER)
  set_target_properties(vla_control_shared PROPERTIES INSTALL_RPATH "$ORIGIN")
  install(TARGETS vla_control_shared EXPORT vlaTargets LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT control
          NAMELINK_COMPONENT development)
  install(FILES include/vla/control.h DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}/vla)
endif()
install(FILES include/vla/vla.h DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}/vla)
install(FILES src/wire/vla.proto DESTINATION ${CMAKE_INSTALL_DATADIR}/vla)
if(NOT CMAKE_CROSSCOMPILING OR CMAKE_CROSSCOMPILING_EMULATOR)
  install(FILES ${CMAKE_BINARY_DIR}/vla.1 DESTINATION ${CMAKE_INSTALL_MANDIR}/man1)
  install(FILES ${CMAKE_BINARY_DIR}/vla.bash DESTINATION ${CMAKE_INSTALL_DATADIR}/bash-completion/completions RENAME vla)
endif()
install(FILES LICENSE LICENSES-third-party.md DESTINATION ${CMAKE_INSTALL_DOCDIR})

set(package_dir ${CMAKE_INSTALL_LIBDIR}/cmake/vla)
configure_package_config_file(cmake/vlaConfig.cmake.in vlaConfig.cmake INSTALL_DESTINATION ${package_dir})
write_basic_package_version_file(vlaConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(EXPORT vlaTargets NAMESPACE vla:: DESTINATION ${package_dir})
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/vlaConfig.cmake ${CMAKE_CURRENT_BINARY_DIR}/vlaConfigVersion.cmake
        DESTINATION ${package_dir})

# Relative to where the file lies, so that an installed tree may be moved.
file(RELATIVE_PATH pc_to_prefix ${CMAKE_INSTALL_FULL_LIBDIR}/pkgconfig ${CMAKE_INSTALL_PREFIX})
configure_file(cmake/vla.pc.in vla.pc @ONLY)
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/vla.pc DESTINATION ${CMAKE_INSTALL_LIBDIR}/pkgconfig)
