# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# `make deb`: what `cmake --install` installs, with a unit of systemd for the server.

if(NOT VLA_DEB)
  return()
endif()
install(FILES packaging/vla@.service DESTINATION /lib/systemd/system)
install(FILES packaging/example.conf DESTINATION /etc/vla)
set(CPACK_GENERATOR DEB)
set(CPACK_PACKAGE_NAME vla)
set(CPACK_PACKAGE_CONTACT "The vla.cpp authors <nobody@localhost>")
set(CPACK_PACKAGE_DESCRIPTION_SUMMARY "Runtime and server of Vision-Language-Action policies")
set(CPACK_PACKAGE_DESCRIPTION "Turns camera frames, a robot's state and an instruction into actions, on CPUs and GPUs:\nthe program vla with its server, libvla.so and its header.")
set(CPACK_PACKAGING_INSTALL_PREFIX /usr)
set(CPACK_SET_DESTDIR ON)
set(CPACK_STRIP_FILES ON)
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_SECTION science)
if(CMAKE_CROSSCOMPILING)  # dpkg's tools look at installed packages: scripts/arm64_depends.sh says which it needs
  set(CPACK_DEBIAN_PACKAGE_ARCHITECTURE arm64)
else()
  set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS ON)
endif()
set(CPACK_DEBIAN_PACKAGE_CONTROL_EXTRA ${CMAKE_SOURCE_DIR}/packaging/conffiles ${CMAKE_SOURCE_DIR}/packaging/postinst
    ${CMAKE_SOURCE_DIR}/packaging/triggers)
set(CPACK_DEBIAN_PACKAGE_CONTROL_STRICT_PERMISSION ON)
include(CPack)
