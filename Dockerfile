# fgloc without ROS, ready for a robot: `docker build -t fgloc .` (on ARM, where `fgloc live` has no wheel:
# `docker build --build-arg EXTRAS= -t fgloc .`), then
#   docker run --rm --network host -v "$PWD:/data" fgloc live --network --map map.yaml --config robot.yaml
#   docker run --rm -v "$PWD:/data" fgloc smooth BAG --out result
FROM python:3.12-slim AS build
WORKDIR /source
ARG EXTRAS=[live]
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY fgloc fgloc
COPY training training
COPY datasets datasets
RUN python -m venv /opt/fgloc \
    && /opt/fgloc/bin/pip install --no-cache-dir -c constraints.txt ".$EXTRAS"

FROM python:3.12-slim
RUN useradd --create-home --uid 1000 fgloc && mkdir /data && chown fgloc /data
COPY --from=build /opt/fgloc /opt/fgloc
ENV PATH=/opt/fgloc/bin:$PATH OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
USER fgloc
WORKDIR /data
ENTRYPOINT ["fgloc"]
CMD ["--help"]
