# Splatwizard on a CPU, kernels compiled. From the root of the repository:
#
#     docker build -f docker/cpu.Dockerfile -t splatwizard .
#     docker run --rm --user "$(id -u):$(id -g)" -e HOME=/tmp -v "$PWD:/home/researcher/here" splatwizard run --scene demo
#
# pip's usual index brings a torch with CUDA, gigabytes that a CPU has no use for: name one with torch's CPU builds with
# --build-arg PIP_EXTRA_INDEX_URL=ADDRESS.
FROM python:3.12-slim-bookworm

RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ make \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/splatwizard
COPY . .
ARG PIP_EXTRA_INDEX_URL
ENV PIP_NO_CACHE_DIR=1 PATH=/opt/venv/bin:$PATH SPLATWIZARD_CACHE=/opt/cache
RUN make VENV=/opt/venv /opt/venv/.ready && sw build-kernels --portable && sw doctor

RUN useradd --create-home --uid 1001 researcher && mkdir -p /home/researcher/here && chmod -R a+rwX /home/researcher /opt/cache
USER 1001
WORKDIR /home/researcher/here
ENTRYPOINT ["sw"]
CMD ["--help"]
