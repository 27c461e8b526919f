# Splatwizard on an NVIDIA GPU. Kernels for the GPU are compiled when first used, into the volume. From the repository's root:
#
#     docker build -f docker/cuda.Dockerfile -t splatwizard:cuda .
#     docker run --rm --gpus all -v splatwizard-cache:/opt/cache --user "$(id -u):$(id -g)" -e HOME=/tmp -v "$PWD:/home/researcher/here" splatwizard:cuda run --scene demo
#
# The toolkit must be of the CUDA release that torch was built for (`python -c 'import torch; print(torch.version.cuda)'`).
FROM nvidia/cuda:13.0.1-devel-ubuntu24.04

RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ make python3 python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/splatwizard
COPY . .
ENV PIP_NO_CACHE_DIR=1 PATH=/opt/venv/bin:$PATH SPLATWIZARD_CACHE=/opt/cache
RUN make VENV=/opt/venv /opt/venv/.ready && sw doctor

RUN useradd --create-home --uid 1001 researcher && mkdir -p /home/researcher/here /opt/cache && chmod -R a+rwX /home/researcher /opt/cache
USER 1001
WORKDIR /home/researcher/here
ENTRYPOINT ["sw"]
CMD ["--help"]
