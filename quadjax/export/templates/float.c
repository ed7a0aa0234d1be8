{% for layer in layers %}
static const float w${loop.index0}[${layer.kernel.size}] = {
${layer.kernel.T | each("float32") | wrapped}};
static const float b${loop.index0}[${layer.bias.size}] = {
${layer.bias | each("float32") | wrapped}};
{% endfor %}
static const float low[4] = {${low | each("float32") | join(", ")}};
static const float span[4] = {${span | each("float32") | join(", ")}};

static void layer(const float *w, const float *b, int rows, int columns, const float *x, float *y,
                  int relu) {
  for (int row = 0; row < rows; ++row) {
    float sum = b[row];
    for (int column = 0; column < columns; ++column) {
      sum += w[row * columns + column] * x[column];
    }
    y[row] = (relu && sum < 0.0F) ? 0.0F : sum;
  }
}

void float_forward(const float *x, float *command) {
  float a[${widest}];
  float b[${widest}];
{% for layer in layers %}
  layer(w${loop.index0}, b${loop.index0}, ${layer.bias.size}, ${layer.kernel.shape[0]}, ${"x" if loop.first else ("b", "a")[loop.index0 % 2]}, ${("a", "b")[loop.index0 % 2]}, ${0 if loop.last else 1});
{% endfor %}
  (void)b;
  for (int i = 0; i < 4; ++i) {
    const float action = ${("b", "a")[layers | length % 2]}[i];
    const float clipped = action < -1.0F ? -1.0F : (action > 1.0F ? 1.0F : action);
    command[i] = low[i] + span[i] * (clipped + 1.0F);
  }
}

void float_batch(const float *x, float *command, unsigned count) {
  for (unsigned i = 0; i < count; ++i) {
    float_forward(x + i * ${inputs}, command + i * 4);
  }
}
