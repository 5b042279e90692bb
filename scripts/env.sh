# SPDX-License-Identifier: Apache-2.0
# Source this in bash or zsh to enter the workspace's environment:  source scripts/env.sh
# It puts ROS 2, the Python environment and the built packages on this shell's paths. It is also
# install/setup.bash, and local_setup.bash of install/ and of .venv/, which the setup.bash of a colcon
# workspace on top of them sources; in .venv/ it leaves out what `make` built.

if [ -n "${BASH_VERSION:-}" ]; then
  _galen_file="${BASH_SOURCE[0]}"
  _galen_shell=bash
elif [ -n "${ZSH_VERSION:-}" ]; then
  eval '_galen_file="${(%):-%x}"' # only zsh can parse this
  _galen_shell=zsh
else
  echo "error: scripts/env.sh needs bash or zsh" >&2
  return 1
fi
_galen_folder="$(cd -- "$(dirname -- "$_galen_file")" > /dev/null && pwd -P)"
_galen_root="${_galen_folder%/*}"

if [ ! -f "$_galen_root/.venv/galen_env.sh" ]; then
  echo "error: no environment in $_galen_root/.venv; run 'make build' there first" >&2
  unset _galen_file _galen_shell _galen_folder _galen_root
  return 1
fi

# The set-up scripts of ROS and colcon read variables that may not be set.
case $- in *u*) _galen_nounset=1 ;; *) _galen_nounset= ;; esac
set +u

_galen_prepend() {
  eval "case \":\${$1:-}:\" in *\":$2:\"*) ;; *) export $1=\"$2\${$1:+:\$$1}\" ;; esac"
}
. "$_galen_root/.venv/galen_env.sh" # sets GALEN_ENV_KIND and GALEN_ROS_PREFIX
if [ "$GALEN_ENV_KIND" = ros ]; then
  if [ -z "${ROS_DISTRO:-}" ]; then
    . "$GALEN_ROS_PREFIX/setup.$_galen_shell"
  fi
else
  _galen_prepend AMENT_PREFIX_PATH "$_galen_root/.venv"
  _galen_prepend CMAKE_PREFIX_PATH "$_galen_root/.venv"
  # Another environment's wheels may have set it: these have to put their own libraries on the path.
  unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
  # Shared memory of a killed process makes Fast DDS complain in red; UDP has no such leftovers.
  # (With discovery limited to this machine rmw_fastrtps chooses for itself.)
  export FASTDDS_BUILTIN_TRANSPORTS="${FASTDDS_BUILTIN_TRANSPORTS:-UDPv4}"
fi
export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
# That range limits whom a node looks for; its ports stay open on all addresses, and who knows the
# address gets in. Fast DDS is told to use 127.0.0.1 only. docs/how-to/security.md says how to open up.
if [ "$ROS_AUTOMATIC_DISCOVERY_RANGE" = LOCALHOST ] && [ -z "${ROS_STATIC_PEERS:-}" ]; then
  export FASTRTPS_DEFAULT_PROFILES_FILE="${FASTRTPS_DEFAULT_PROFILES_FILE:-$_galen_root/galen_bringup/config/fastdds_this_host.xml}"
elif [ "${FASTRTPS_DEFAULT_PROFILES_FILE:-}" = "$_galen_root/galen_bringup/config/fastdds_this_host.xml" ]; then
  unset FASTRTPS_DEFAULT_PROFILES_FILE # sourced again, to open up
fi

export VIRTUAL_ENV="$_galen_root/.venv"
_galen_prepend PATH "$VIRTUAL_ENV/bin"
# Last on PATH: a real `ros2` wins over the stand-in.
case ":$PATH:" in
  *":$_galen_root/scripts/fallback_bin:"*) ;;
  *) export PATH="$PATH:$_galen_root/scripts/fallback_bin" ;;
esac

if [ "${_galen_folder##*/}" != .venv ] && [ -f "$_galen_root/install/galen_build_stamp" ]; then
  _galen_prepend AMENT_PREFIX_PATH "$_galen_root/install"
  _galen_prepend CMAKE_PREFIX_PATH "$_galen_root/install"
  _galen_prepend PYTHONPATH "$_galen_root/install/python"
  _galen_prepend LD_LIBRARY_PATH "$_galen_root/install/lib" # the messages' type support
fi

if [ -n "$_galen_nounset" ]; then set -u; fi
unset _galen_file _galen_shell _galen_folder _galen_root _galen_nounset
unset -f _galen_prepend
