#!/usr/bin/env bash
# Create .venv and install the lock: no root, nothing global, never a CUDA torch on a machine without a GPU.
# device=cuda: the lock's torch as built for CUDA, and the extra `cuda` (gsplat).
set -euo pipefail
cd "$(dirname "$0")/.."
py=.venv/bin/python
device=${device:-}

has_gpu() { [ -e /proc/driver/nvidia/version ] || nvidia-smi -L >/dev/null 2>&1; }
case "$device" in
  "" | auto | cpu) ;;
  cuda) has_gpu || { echo "setup: device=cuda: this machine has no NVIDIA driver; install it first" >&2; exit 2; } ;;
  *) echo "setup: device=$device is none of auto, cpu, cuda" >&2; exit 2 ;;
esac

# A checkout without symbolic links (core.symlinks=false), or a zip unpacked without them, has files in their place.
if [ -f chebsplat/stages ]; then
  echo "setup: chebsplat/stages is a file where a link belongs: putting the links in place" >&2
  for folder in formats pipelines stages teachers; do ln -sfn ../$folder chebsplat/$folder; done
fi

# A torch that lies in a folder which pip is told to look in (find-links) decides for the Pythons it is built for.
links=$(python3 -m pip config get global.find-links 2>/dev/null || true)
wheels=$(for folder in $links; do compgen -G "$folder/torch-2.13.0*.whl" || true; done)

# The newest Python on the PATH that the lock is resolved for and that can make a .venv; PYTHON=... names another.
newest_python() {
  local candidate tag why=""
  for candidate in ${PYTHON:-python3.13 python3.12 python3.11 python3}; do
    tag=$("$candidate" -c 'import sys; print("cp%d%d" % sys.version_info[:2])' 2>/dev/null) || continue
    if [[ ! $tag =~ ^cp31[123]$ ]]; then
      why+="; $candidate is $tag"
    elif [[ -n $wheels && $wheels != *-$tag-* ]]; then
      why+="; the torch in $links is not built for $candidate"
    elif ! "$candidate" -c 'import ensurepip, venv' 2>/dev/null; then
      why+="; $candidate has no venv (Debian, Ubuntu: apt install $candidate-venv)"
    else
      echo "$candidate" && return
    fi
  done
  echo "setup: Python 3.11, 3.12 or 3.13 is needed on the PATH (Debian, Ubuntu: apt install python3 python3-venv;" \
    "elsewhere: https://www.python.org/downloads), or make PYTHON=/path/to/python3.12$why" >&2
  exit 2
}

# Programs in .venv begin with its path: one that was made elsewhere (a renamed or copied clone) runs nothing here.
made=$(sed -n 's|^command = .* -m venv [^/]*/|/|p' .venv/pyvenv.cfg 2>/dev/null || true)
if [ -n "$made" ] && [ "$made" != "$(realpath .venv)" ]; then
  echo "setup: .venv was made for $made; making it anew" >&2
  rm -rf .venv
fi
if [ ! -x $py ]; then
  python=$(newest_python)
  echo "setup: making .venv with $("$python" --version)" >&2
  "$python" -m venv .venv
fi
$py -m pip install --quiet "uv==0.13.8"

# uv does not read pip's configuration: hand over its find-links. Without a torch there, uv picks the build that fits
# the machine (`--torch-backend auto`: CPU where there is no NVIDIA GPU).
options=()
for folder in $links; do options+=(--find-links "$folder"); done
[ -n "$wheels" ] || options+=(--torch-backend auto)
if [ "$device" = cuda ]; then  # not from a folder of wheels for the CPU, nor what is installed of them
  options=(--torch-backend auto)
  $py -c 'import sys, torch; sys.exit(torch.version.cuda is None)' 2>/dev/null || options+=(--reinstall-package torch)
fi
$py -m uv pip install --quiet --python $py -r requirements.lock "${options[@]}"
$py -m uv pip install --quiet --python $py --no-deps --editable .
[ "$device" != cuda ] || $py -m uv pip install --quiet --python $py --constraint requirements.lock --editable '.[cuda]'

# What a bare system lacks is named now, not by the first stage.
if ! why=$($py -c 'from chebsplat.synthetic.rays import open3d; open3d()' 2>&1); then
  echo "setup: ${why##*$'\n'}" >&2
  exit 2
fi

if ! has_gpu; then
  $py -c 'import sys, torch; sys.exit(f"setup: a CUDA torch ({torch.__version__}) on a machine without a GPU" if torch.version.cuda else 0)'
fi
echo "setup: ready ($($py --version))" >&2
