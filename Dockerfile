# locatk with all extras. The demo writes report.html into the current folder:
#   docker build -t locatk . && docker run --rm -v "$PWD:/data" locatk
# Other commands work on the files of that folder:
#   docker run --rm -v "$PWD:/data" locatk locatk solve run.mcap -o solved.mcap
FROM python:3.12-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source

FROM python:3.12-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir "$(echo /wheels/*.whl)[all]" && rm -r /wheels
WORKDIR /data
CMD ["locatk", "demo"]
