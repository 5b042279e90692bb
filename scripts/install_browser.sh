#!/bin/bash
# SPDX-License-Identifier: Apache-2.0
# Installs Chromium and its driver from the system's packages, where they are not there yet and this
# may be done without asking; else it says what to install. The panel's tests in a browser need
# them, and are skipped without them; nothing else does.
packages="chromium chromium-driver fonts-dejavu-core"

if command -v chromium > /dev/null && command -v chromedriver > /dev/null; then
  echo "chromium and its driver are there"
  exit 0
fi
if [ "$(id -u)" = 0 ]; then
  root=(env)
elif sudo -n true 2> /dev/null; then
  root=(sudo -n)
fi
if [ -z "${root:-}" ] || ! command -v apt-get > /dev/null; then
  echo "the panel's tests in a browser need Chromium and its driver; on Debian: sudo apt-get install $packages" >&2
  exit 1
fi
export DEBIAN_FRONTEND=noninteractive
"${root[@]}" apt-get update -q && "${root[@]}" apt-get install -y -q --no-install-recommends $packages
