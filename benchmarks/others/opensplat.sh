#!/usr/bin/env bash
# Builds OpenSplat for the CPU against this project's torch, without CMake:
#   apt-get install g++ libopencv-dev nlohmann-json3-dev libnanoflann-dev libcxxopts-dev
#   git clone https://github.com/pierotofy/OpenSplat && git -C OpenSplat checkout 15b7e80
#   bash benchmarks/others/opensplat.sh OpenSplat OUT
set -euo pipefail
source=$1 out=$2 python=${PYTHON:-.venv/bin/python}
torch=$($python -c 'import pathlib, torch; print(pathlib.Path(torch.__file__).parent)')
abi=$($python -c 'import torch; print(int(torch.compiled_with_cxx11_abi()))')
mkdir -p "$out"
flags=(-O3 -DNDEBUG -std=c++20 -w -fopenmp -D_GLIBCXX_USE_CXX11_ABI="$abi" '-DAPP_VERSION="15b7e80"'
  '-DAPP_REVISION="15b7e80"' -I"$source/rasterizer" -I"$torch/include"
  -I"$torch/include/torch/csrc/api/include" -I/usr/include/opencv4)
for file in opensplat point_io nerfstudio model kdtree_tensor spherical_harmonics cv_utils utils \
  project_gaussians rasterize_gaussians ssim optim_scheduler colmap opensfm openmvg input_data \
  tensor_math rasterizer/gsplat-cpu/gsplat_cpu; do
  object=$out/$(basename $file).o
  if [ ! -e "$object" ] || [ "$source/$file.cpp" -nt "$object" ]; then
    g++ "${flags[@]}" -c "$source/$file.cpp" -o "$object"
  fi
done
g++ "$out"/*.o -o "$out/opensplat" -L"$torch/lib" -Wl,-rpath,"$torch/lib" -fopenmp -ltorch \
  -ltorch_cpu -lc10 -lopencv_core -lopencv_imgproc -lopencv_highgui -lopencv_calib3d \
  -lopencv_imgcodecs -lpthread
